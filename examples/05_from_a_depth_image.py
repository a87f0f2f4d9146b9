"""Grasps from above of what a depth camera sees, in the frame of the robot's base, above the table."""

import numpy as np
import torch

import dro_grasp as dro
from dro_grasp.objects.camera import DepthCamera, visible_points

# A rendered view stands in for the camera: its points, seen from the side and above.
duck = dro.load_object("rubber_duck")
seen = visible_points(duck, torch.tensor([1.0, 0.3, 1.2]), torch.Generator().manual_seed(0), DepthCamera(noise=0.001)).numpy()

# With a real one: points = dro.depth_points(depth, intrinsics, mask), in the camera's frame, and its pose in the base's.
T_base_camera = np.eye(4)
obj = dro.scanned_object("seen", seen - seen.mean(0) + [0.0, 0.0, 0.6], T_base_camera)

table = float(obj.cloud[:, 2].min()) - 0.04
grasps = dro.GraspPredictor().predict(dro.load_hand("allegro"), obj, num=8, direction=(0.0, 0.0, -1.0), table=table)
print(f"{obj.notes[0]}")
for i in range(3):
    x, y, z = grasps.T_object_wrist[i, :3, 3].tolist()
    print(f"grasp {i}: wrist at ({x:.3f}, {y:.3f}, {z:.3f}) m in the base frame, score {float(grasps.score[i]):.2f}")
