"""Views of objects: depth images and clouds, and completion of the unseen side."""
