"""URDF and MJCF files in, descriptions of hands out, with repairs and notes."""
