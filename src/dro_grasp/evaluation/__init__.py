"""Metrics, controls and benchmark tables."""
