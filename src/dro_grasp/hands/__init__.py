"""Hands derived from any description."""
