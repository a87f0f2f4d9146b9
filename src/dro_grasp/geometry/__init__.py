"""Geometry on tensors: knows no robot and reads no file."""
