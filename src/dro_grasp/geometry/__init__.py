"""Geometry on tensors: knows no robot, reads no file."""
