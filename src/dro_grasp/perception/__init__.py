"""What cameras see: depth images and clouds, and the side of an object that they do not see."""
