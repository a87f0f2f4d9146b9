"""The training bundle: its file and its splits."""
