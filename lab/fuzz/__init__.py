"""Damaged files against every reader, and commands that are stopped in the middle."""
