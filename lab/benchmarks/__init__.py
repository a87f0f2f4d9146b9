"""Measurements of what ships, run from the repository root: `python -m lab.benchmarks.trials`."""
