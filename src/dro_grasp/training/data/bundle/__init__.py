"""The training bundle and its splits."""
