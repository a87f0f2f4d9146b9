"""Objects: meshes, point clouds, and what a camera sees of them."""
