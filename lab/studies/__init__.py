"""Experiments that are over and still run; `lab/notebook` says what they gave."""
