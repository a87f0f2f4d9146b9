"""Grasps: the batch type, controller, energies, synthesis, ranking."""
