"""Kinematic trees: loading, forward kinematics, the joint solver."""
