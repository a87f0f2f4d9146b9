"""The grasp server: a process that stays, so that a robot does not wait for Python, weights and hands to load."""
