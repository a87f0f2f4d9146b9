"""What makes a configuration of hand and object a grasp: the terms of the grasp energy."""
