"""Pictures of triangle meshes: arrays in, pixels out."""
