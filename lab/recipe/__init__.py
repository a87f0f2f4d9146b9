"""The recipe of data and weights: every step a command with a seed, resumed after a stop; `python -m lab.recipe --help`."""
