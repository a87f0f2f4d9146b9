"""Descents of the grasp energy: synthesis from nothing, refinement of any grasps."""
