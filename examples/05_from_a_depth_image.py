"""Grasps of an object in a depth image: from above, over a table, in the frame of the robot's base."""

import numpy as np
import torch

import dro_grasp as dro

# A rendered view stands in for the camera, and the duck's frame for the robot's base. The camera looks at the duck from one
# metre away, from the side and above. Its z axis points forward, x right and y down, as in drivers of depth cameras.
duck = dro.load_object("rubber_duck")
direction, camera = torch.tensor([1.0, 0.3, 1.2]), dro.DepthCamera(distance=1.0, noise=0.001)
ahead = -direction.double().numpy() / float(direction.norm())
right = np.cross(ahead, [0.0, 0.0, 1.0])
right /= np.linalg.norm(right)
T_base_camera = np.eye(4)
T_base_camera[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], 1)
T_base_camera[:3, 3] = camera.place(duck, direction)
in_base = dro.visible_points(duck, direction, torch.Generator().manual_seed(0), camera).double().numpy()

# With a real camera: points = dro.depth_points(depth, intrinsics, mask), and T_base_camera from the calibration.
points = (in_base - T_base_camera[:3, 3]) @ T_base_camera[:3, :3]
height = float(duck.cloud[:, 2].min())  # The robot knows the height of the table that it is mounted on.
table = [*T_base_camera[2, :3], height - T_base_camera[2, 3]]  # The same plane in the camera's frame: the duck stands on it.
obj = dro.scanned_object("seen", points, T_base_camera, table=table)
grasps = dro.GraspPredictor().predict(dro.load_hand("allegro"), obj, num=8, direction=(0.0, 0.0, -1.0), table=height)
print(f"{obj.notes[0]}")
for place, score in zip(grasps.T_object_wrist[:3, :3, 3].tolist(), grasps.score.tolist(), strict=False):
    x, y, z = place
    print(f"wrist at ({x:.3f}, {y:.3f}, {z:.3f}) m in the base frame, score {score:.2f}")
