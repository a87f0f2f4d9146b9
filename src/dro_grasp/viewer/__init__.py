"""The browser viewer and headless pictures."""
