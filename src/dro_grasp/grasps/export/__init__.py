"""Grasps in the formats of other programs, each of which states its frames and units."""
