"""Arms: a robot's description, inverse kinematics, collision-free motion to a grasp, timing, and lifts in simulation."""
