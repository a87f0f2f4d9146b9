"""Methods of others, re-implemented, as the benchmark takes any class: `--method lab.methods.gendexgrasp:GenDexGrasp`."""

from pathlib import Path

WEIGHTS = Path(__file__).parents[1] / "weights"
"""Folder of their weights."""
EXPECTED = "weights of this method; train them again (`python -m lab.methods.train`)"
"""What a file with them should be, and a remedy."""
