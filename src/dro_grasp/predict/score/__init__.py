"""Scores that say which grasps will hold."""
