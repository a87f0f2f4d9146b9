"""Collections of grasp files: merge, filter, check, import, bundle."""
