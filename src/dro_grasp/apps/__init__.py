"""The viewer and the grasp server, and what their pages share: who may ask, and what may be sent."""
