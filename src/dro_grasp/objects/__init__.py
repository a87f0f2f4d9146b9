"""Objects: meshes and point clouds, by name, from files, or as a camera sees them."""
