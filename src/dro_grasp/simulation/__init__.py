"""Physics trials of grasps in MuJoCo."""
