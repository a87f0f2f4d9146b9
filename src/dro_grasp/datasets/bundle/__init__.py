"""The training file and its splits."""
