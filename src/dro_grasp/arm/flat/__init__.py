"""Flat and thin things: seen by outlines, pushed to an edge of the table, and taken where they overhang."""
