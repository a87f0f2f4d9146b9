"""Grasps as messages of MoveIt. Source: moveit_msgs/Grasp of MoveIt 2."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.errors import OptionError
from dro_grasp.export.contents import Frame, comment, confidence, plain, postures, yaml_text
from dro_grasp.export.formats import ExportJob
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand

APPROACH = 0.10
"""Wished path of the hand along its palm direction before the grasp [m] (ours)."""
RETREAT = 0.10
"""Wished path away from the grasp [m] (ours)."""
SHORTEST = 0.02
"""Least path of either [m] (ours)."""


def moveit_grasps(grasps: GraspBatch, hand: Hand, frame: Frame) -> str:
    """A YAML list of moveit_msgs/Grasp, with the wrist link's pose and the fingers' postures.

    The hand approaches along its palm direction and retreats along z of the frame, which is up in a robot's base. A grasp
    without a score has no `grasp_quality`.
    """
    position, quaternion = frame.place(grasps)
    joints = postures(grasps)
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": frame.name_for(grasps)}
    at_wrist = {**header, "frame_id": grasps.wrist_link}
    palm = hand.palm_direction_wrist
    messages = []
    for i in range(len(grasps)):
        orientation = dict(zip("wxyz", plain(quaternion[i]), strict=True))
        pose = {"position": dict(zip("xyz", plain(position[i]), strict=True)), "orientation": orientation}
        quality = confidence(grasps, i)
        messages.append({
            "id": f"grasp_{i}", "pre_grasp_posture": _posture(grasps, at_wrist, joints["pregrasp"][i]),
            "grasp_posture": _posture(grasps, at_wrist, joints["squeeze"][i]),
            "grasp_pose": {"header": header, "pose": pose}, **({} if quality is None else {"grasp_quality": quality}),
            "pre_grasp_approach": _path(at_wrist, palm, APPROACH),
            "post_grasp_retreat": _path(header, torch.tensor([0.0, 0.0, 1.0]), RETREAT),
            "post_place_retreat": _path(at_wrist, -palm, RETREAT),
            "max_contact_force": 0.0, "allowed_touch_objects": [grasps.object[i]],
        })
    return comment(grasps, frame) + yaml_text(messages)


def _posture(grasps: GraspBatch, header: dict[str, Any], joints: Float[Tensor, " n_dof"]) -> dict[str, Any]:
    """A trajectory_msgs/JointTrajectory of one point."""
    point = {"positions": plain(joints), "velocities": [], "accelerations": [], "effort": [],
             "time_from_start": {"sec": 0, "nanosec": 0}}
    return {"header": header, "joint_names": list(grasps.joint_names), "points": [point]}


def _path(header: dict[str, Any], direction: Float[Tensor, "3"], wished: float) -> dict[str, Any]:
    """A moveit_msgs/GripperTranslation."""
    return {"direction": {"header": header, "vector": dict(zip("xyz", plain(direction), strict=True))},
            "desired_distance": wished, "min_distance": SHORTEST}


def content(job: ExportJob) -> bytes:
    """One object's file.

    Raises:
        OptionError: The job names no hand.
    """
    if job.hand is None:
        raise OptionError("MoveIt messages state the palm direction: give the hand of the grasps")
    return moveit_grasps(job.grasps, job.hand, job.frame).encode()
