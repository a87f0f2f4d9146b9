"""Grasps as DexGraspBench reads them. Source: readme of DexGraspBench."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import torch

from dro_grasp.export.contents import Frame, postures
from dro_grasp.export.formats import ExportJob
from dro_grasp.geometry.se3 import roma
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.sources import camera_pose


def dexgraspbench(grasps: GraspBatch, frame: Frame, object_path: str, scale: float) -> list[dict[str, Any]]:
    """One dictionary per grasp, as DexGraspBench reads it from a npy file.

    Postures are wrist pose (x y z, qw qx qy qz) and joints in one row; `obj_pose` is the pose of the object's file in their
    frame, WXYZ as well.
    """
    position, quaternion = frame.place(grasps)
    joints = postures(grasps)
    camera = camera_pose(grasps)  # the file of a camera's cloud is in the camera's frame
    T = frame.T_frame_object.double() if camera is None else frame.T_frame_object.double() @ camera.double()
    turn = roma.quat_xyzw_to_wxyz(roma.rotmat_to_unitquat(roma.special_procrustes(T[:3, :3])))
    pose = torch.cat([T[:3, 3], turn])
    found = []
    for i in range(len(grasps)):
        wrist = torch.cat([position[i], quaternion[i]])
        qpos = {f"{name}_qpos": torch.cat([wrist, values[i].double()]).numpy() for name, values in joints.items()}
        found.append({
            **qpos, "obj_scale": scale, "obj_pose": pose.numpy(), "obj_path": object_path, "hand": grasps.hand,
            "wrist_link": grasps.wrist_link, "joint_names": list(grasps.joint_names), "frame": frame.name_for(grasps),
            "units": "m, rad",
        })
    return found


def content(job: ExportJob) -> list[bytes]:
    """One object's files, one per grasp."""
    files = []
    for entry in dexgraspbench(job.grasps, job.frame, job.object_path, job.object_scale):
        file = io.BytesIO()
        np.save(file, np.array(entry, dtype=object), allow_pickle=True)
        files.append(file.getvalue())
    return files
