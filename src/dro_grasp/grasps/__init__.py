"""Grasps: the batch type, its columns and files, the controller, duplicates."""
