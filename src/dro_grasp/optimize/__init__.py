"""The grasp energy of a hand on an object: contact candidates, terms and their weighted sum."""
