"""From a robot, an object and what stands around to a timed motion that grasps, lifts and puts down, rehearsed before."""
