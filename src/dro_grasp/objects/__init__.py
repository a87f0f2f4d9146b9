"""Objects: meshes and point clouds."""
