"""Robots: an arm that carries a hand, from a robot file; what its drivers take."""
