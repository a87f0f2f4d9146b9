"""Kinematic trees: forward kinematics, Jacobians and the joint solver, on tensors alone."""
