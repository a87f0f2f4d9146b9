"""Export the grasps that hold: as isaac_grasp YAML, and as moveit_msgs/Grasp in the robot's frame."""

from pathlib import Path

import torch

import dro_grasp as dro

hand, obj = dro.load_hand("barrett"), dro.load_object("can")
grasps = dro.GraspPredictor().predict(hand, obj, num=8)
grasps = grasps.with_trial(dro.simulate(hand, obj, grasps))
held = grasps[grasps.success]

T_base_object = torch.eye(4)
T_base_object[:3, 3] = torch.tensor([0.5, 0.0, 0.12])
out = Path("out")
out.mkdir(exist_ok=True)
(out / "grasps_isaac.yaml").write_text(dro.isaac_grasp(held, dro.Frame()))
(out / "grasps_moveit.yaml").write_text(dro.moveit_grasps(held, hand, dro.Frame("base_link", T_base_object)))
print(f"{len(held)} of {len(grasps)} grasps written to {out}/grasps_isaac.yaml and {out}/grasps_moveit.yaml")
