"""Hands that do not exist: plans drawn at random, written as URDF, kept if they can grasp."""
