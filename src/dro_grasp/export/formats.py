"""Grasps in the formats of other programs, each of which states its frames and units.

Sources: Isaac Sim's and Isaac ROS's documentation of isaac_grasp files, version 1.0; moveit_msgs/Grasp of MoveIt 2; the
readme of DexGraspBench.
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import roma
import torch
import yaml
from jaxtyping import Float
from torch import Tensor

from dro_grasp.errors import OptionError
from dro_grasp.frames import read_motion
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.sources import frame_of
from dro_grasp.hands.hand import Hand

OBJECT = "object"
"""Name of the frame that grasps are stored in: that of the object's mesh or cloud."""
APPROACH, SHORTEST_APPROACH = 0.10, 0.02
"""Wished and least way of the hand along its palm direction before the grasp [m]."""
RETREAT, SHORTEST_RETREAT = 0.10, 0.02
"""Wished and least way up after it [m]."""


@dataclass(frozen=True)
class Frame:
    """The frame that poses are given in."""

    name: str = OBJECT
    T_frame_object: Float[Tensor, "4 4"] = field(default_factory=lambda: torch.eye(4))
    """Takes coordinates of the object's frame to this one [m]."""

    @staticmethod
    def load(path: Path) -> Frame:
        """Read `{"frame": NAME, "T_frame_object": 4x4}`.

        Raises:
            OptionError: No such file, no such content, or no rigid motion.
        """
        return Frame(*read_motion(path, "T_frame_object"))

    def place(self, grasps: GraspBatch) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 4"]]:
        """Positions [m] and unit quaternions (WXYZ, w not negative) of the wrists in this frame."""
        T = self.T_frame_object.to(grasps.T_object_wrist) @ grasps.T_object_wrist
        quaternion = roma.quat_xyzw_to_wxyz(roma.rotmat_to_unitquat(roma.special_procrustes(T[:, :3, :3].double())))
        return T[:, :3, 3].double(), torch.where(quaternion[:, :1] < 0, -quaternion, quaternion)


def isaac_grasp(grasps: GraspBatch, frame: Frame) -> str:
    """An isaac_grasp YAML file, format version 1.0, of grasps of one object, with pregrasps."""
    position, quaternion = frame.place(grasps)
    pregrasp = _postures(grasps)["pregrasp"]
    entries = {}
    for i in range(len(grasps)):
        w, *xyz = _plain(quaternion[i])
        entries[f"grasp_{i}"] = {
            "confidence": _confidence(grasps, i), "position": _plain(position[i]), "orientation": {"w": w, "xyz": xyz},
            "cspace_position": _named(grasps, grasps.joints[i]), "pregrasp_cspace_position": _named(grasps, pregrasp[i]),
        }
    content = {"format": "isaac_grasp", "format_version": 1.0, "object_frame_link": _frame_of(grasps, frame),
               "gripper_frame_link": grasps.wrist_link, "grasps": entries}
    return _comment(grasps, frame) + _yaml(content)


def moveit_grasps(grasps: GraspBatch, hand: Hand, frame: Frame) -> str:
    """A YAML list of moveit_msgs/Grasp, with the wrist link's pose and the fingers' postures.

    The hand approaches along its palm direction and retreats along z of the frame, which is up in a robot's base.
    """
    position, quaternion = frame.place(grasps)
    postures = _postures(grasps)
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": _frame_of(grasps, frame)}
    at_wrist = {**header, "frame_id": grasps.wrist_link}

    def posture(joints: Tensor) -> dict[str, Any]:
        point = {"positions": _plain(joints), "velocities": [], "accelerations": [], "effort": [],
                 "time_from_start": {"sec": 0, "nanosec": 0}}
        return {"header": at_wrist, "joint_names": list(grasps.joint_names), "points": [point]}

    def way(where: dict[str, Any], along: Tensor, wished: float, least: float) -> dict[str, Any]:
        return {"direction": {"header": where, "vector": dict(zip("xyz", _plain(along), strict=True))},
                "desired_distance": wished, "min_distance": least}

    messages = []
    for i in range(len(grasps)):
        orientation = dict(zip("wxyz", _plain(quaternion[i]), strict=True))
        pose = {"position": dict(zip("xyz", _plain(position[i]), strict=True)), "orientation": orientation}
        messages.append({
            "id": f"grasp_{i}", "pre_grasp_posture": posture(postures["pregrasp"][i]),
            "grasp_posture": posture(postures["squeeze"][i]),
            "grasp_pose": {"header": header, "pose": pose}, "grasp_quality": _confidence(grasps, i),
            "pre_grasp_approach": way(at_wrist, hand.palm_direction_wrist, APPROACH, SHORTEST_APPROACH),
            "post_grasp_retreat": way(header, torch.tensor([0.0, 0.0, 1.0]), RETREAT, SHORTEST_RETREAT),
            "post_place_retreat": way(at_wrist, -hand.palm_direction_wrist, RETREAT, SHORTEST_RETREAT),
            "max_contact_force": 0.0, "allowed_touch_objects": [grasps.object[i]],
        })
    return _comment(grasps, frame) + _yaml(messages)


def csv_table(grasps: GraspBatch, frame: Frame) -> str:
    """One line a grasp: pose, score, outcome and the joints of all postures, after comment lines."""
    position, quaternion = frame.place(grasps)
    postures = _postures(grasps)
    text = io.StringIO()
    text.write(_comment(grasps, frame))
    writer = csv.writer(text, lineterminator="\n")
    names = [f"{posture}:{joint}" for posture in postures for joint in grasps.joint_names]
    writer.writerow(["object", "x", "y", "z", "qw", "qx", "qy", "qz", "score", "success", "protocol", *names])
    for i in range(len(grasps)):
        known = bool(grasps.evaluated[i])
        writer.writerow([
            grasps.object[i], *_plain(position[i]), *_plain(quaternion[i]),
            _known(grasps.score[i]), int(grasps.success[i]) if known else "", grasps.protocol[i],
            *(value for joints in postures.values() for value in _plain(joints[i])),
        ])
    return text.getvalue()


def dexgraspbench(grasps: GraspBatch, frame: Frame, object_path: str, scale: float) -> list[dict[str, Any]]:
    """One dictionary a grasp, as DexGraspBench reads it from a npy file.

    Postures are wrist pose (x y z, qw qx qy qz) and joints in one row; `obj_pose` is the object's pose in their frame, WXYZ
    as well.
    """
    position, quaternion = frame.place(grasps)
    postures = _postures(grasps)
    turn = roma.quat_xyzw_to_wxyz(roma.rotmat_to_unitquat(frame.T_frame_object[:3, :3].double()))
    pose = torch.cat([frame.T_frame_object[:3, 3].double(), turn])
    found = []
    for i in range(len(grasps)):
        wrist = torch.cat([position[i], quaternion[i]])
        qpos = {f"{name}_qpos": torch.cat([wrist, joints[i].double()]).numpy() for name, joints in postures.items()}
        found.append({
            **qpos, "obj_scale": scale, "obj_pose": pose.numpy(), "obj_path": object_path, "hand": grasps.hand,
            "wrist_link": grasps.wrist_link, "joint_names": list(grasps.joint_names), "frame": _frame_of(grasps, frame),
            "units": "m, rad",
        })
    return found


def _postures(grasps: GraspBatch) -> dict[str, Float[Tensor, "n n_dof"]]:
    """Joints of pregrasp, grasp and squeeze, in the order in which a hand goes through them.

    Raises:
        OptionError: The grasps have none.
    """
    if not bool(torch.stack([grasps.pregrasp_joints, grasps.squeeze_joints]).isfinite().all()):
        raise OptionError("these grasps have no pregrasp and squeeze; `dro-grasp export` makes them")
    return {"pregrasp": grasps.pregrasp_joints, "grasp": grasps.joints, "squeeze": grasps.squeeze_joints}


def _confidence(grasps: GraspBatch, i: int) -> float:
    """The logistic function of the score; one half where there is none."""
    score = float(grasps.score[i])
    return round(1 / (1 + math.exp(-max(-30.0, min(30.0, score)))), 6) if math.isfinite(score) else 0.5


def _frame_of(grasps: GraspBatch, frame: Frame) -> str:
    return frame.name if frame.name != OBJECT else frame_of(grasps) or grasps.object[0]


def _comment(grasps: GraspBatch, frame: Frame) -> str:
    own = frame.name == OBJECT and frame_of(grasps) is None
    where = f"the mesh frame of object '{grasps.object[0]}'" if own else f"frame '{_frame_of(grasps, frame)}'"
    return (
        f"# Grasps by hand '{grasps.hand}': poses of link '{grasps.wrist_link}' in {where}.\n"
        "# Metres and radians; quaternions by name or WXYZ. Joints are the independent ones; mimic joints follow them.\n"
        "# Score: higher is better, log-odds of holding where it is predicted; confidence is its logistic function.\n"
    )


def _named(grasps: GraspBatch, joints: Tensor) -> dict[str, float]:
    return dict(zip(grasps.joint_names, _plain(joints), strict=True))


def _plain(values: Tensor) -> list[float]:
    """Numbers that read well: a ten-millionth is finer than any robot."""
    return [round(float(v), 7) for v in values]


def _known(value: Float[Tensor, ""]) -> float | str:
    """A number, or nothing where it is unknown."""
    return _plain(value[None])[0] if bool(value.isfinite()) else ""


def _yaml(content: Any) -> str:
    return yaml.dump(content, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=120)


class _Dumper(yaml.SafeDumper):
    """Without anchors, which other readers do not expect."""

    def ignore_aliases(self, data: Any) -> bool:
        return True
