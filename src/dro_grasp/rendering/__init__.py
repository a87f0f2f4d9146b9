"""Arrays in, pixels out: a small software rasterizer."""
