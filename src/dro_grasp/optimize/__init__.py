"""The grasp energy of a hand on an object, and what descends it: synthesis, refinement, fingers and squeeze."""
