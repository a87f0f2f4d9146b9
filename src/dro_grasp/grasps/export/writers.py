"""Grasps in the formats of other programs: what all say about grasps and in which frame, and one function for each."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from jaxtyping import Float
from torch import Tensor

from dro_grasp.errors import OptionError
from dro_grasp.frames import is_name, motion_fault, read_motion
from dro_grasp.geometry.se3 import roma
from dro_grasp.grasps import columns
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import HOLD_COLUMNS, WEIGHT_COLUMN
from dro_grasp.grasps.export.formats import ExportJob
from dro_grasp.grasps.forces import efforts_of, known, squeeze_efforts
from dro_grasp.grasps.hold import HoldExpectation
from dro_grasp.grasps.sources import camera_pose, frame_of
from dro_grasp.hands.hand import Hand

OBJECT = "object"  # Name of the frame that grasps are stored in: that of the object's mesh or cloud


@dataclass(frozen=True)
class Frame:
    """The frame that poses are given in."""

    name: str = OBJECT
    """Name of the frame."""
    T_frame_object: Float[Tensor, "4 4"] = field(default_factory=lambda: torch.eye(4))
    """Takes coordinates of the object's frame to this one [m]."""

    def __post_init__(self) -> None:
        """Refuse names that would break the files, and what is no rigid motion: OptionError."""
        if not is_name(self.name):
            raise OptionError(f"the frame is called {self.name!r}; expected a name on one line, without control characters")
        if (fault := motion_fault(self.T_frame_object)) is not None:
            raise OptionError(f"T_frame_object of frame '{self.name}' must be a rigid motion, in metres; {fault}")

    @staticmethod
    def load(path: Path) -> Frame:
        """Read `{"frame": NAME, "T_frame_object": 4x4}`.

        Raises:
            OptionError: No such file, no such content, or no rigid motion; or another frame has the name of the object's own.
        """
        frame = Frame(*read_motion(path, "T_frame_object"))
        if frame.name == OBJECT and not torch.equal(frame.T_frame_object, torch.eye(4).to(frame.T_frame_object)):
            raise OptionError(f"{path} calls its frame '{OBJECT}', as the object's own is called; give it another name, such "
                              "as 'world'")
        return frame

    def place(self, grasps: GraspBatch) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 4"]]:
        """Positions [m] and unit quaternions (WXYZ, w not negative) of the wrists in this frame."""
        T = self.T_frame_object.to(grasps.T_object_wrist) @ grasps.T_object_wrist
        quaternion = roma.quat_xyzw_to_wxyz(roma.rotmat_to_unitquat(roma.special_procrustes(T[:, :3, :3].double())))
        return T[:, :3, 3].double(), torch.where(quaternion[:, :1] < 0, -quaternion, quaternion)

    def stated(self, grasps: GraspBatch) -> str:
        """This frame's name, or that which grasps give the frame of their object; 'object' where that has none."""
        return (frame_of(grasps) if self.name == OBJECT else None) or self.name

    def name_for(self, grasps: GraspBatch) -> str:
        """This frame's name; the object's own frame has the name that its grasps give it, or else the object's.

        Raises:
            OptionError: The frame is the object's, and there are several objects, or none.
        """
        if self.name != OBJECT:
            return self.name
        if (named := frame_of(grasps)) is not None:
            return named
        if len(set(grasps.object)) != 1:
            raise OptionError(f"{len(grasps)} grasps of {len(set(grasps.object))} objects; a file has the frame of one object, "
                              "so export the grasps of each (GraspBatch.by_object)")
        return grasps.object[0]

    def sentence(self, grasps: GraspBatch) -> str:
        """A sentence that states this frame, for comments in files."""
        own = self.name == OBJECT and frame_of(grasps) is None
        return f"{'the mesh frame of object' if own else 'frame'} '{self.name_for(grasps)}'"


def postures(grasps: GraspBatch) -> dict[str, Float[Tensor, "n n_dof"]]:
    """Joints of pregrasp, grasp and squeeze, in this order [rad or m]; OptionError: a grasp states no pregrasp or squeeze."""
    if not bool(grasps.states_closing.all()):
        raise OptionError("these grasps have no pregrasp and squeeze; `dro-grasp export` makes them, and so does "
                          "`dro_grasp.complete(problem, grasps)`")
    return {"pregrasp": grasps.pregrasp_joints, "grasp": grasps.joints, "squeeze": grasps.squeeze_joints}


def confidence(grasps: GraspBatch, i: int) -> float | None:
    """Predicted probability that a grasp holds, as files state it; None without a score."""
    stated = known(grasps.confidence[i])
    return None if stated is None else round(stated, 6)


FORCES = ("Efforts in Nm, in N where a joint slides, of independent joints, for all that they move; positive toward larger "
          "values. Payload in kg; squeeze_force: sum of normal forces in N.")
"""What a reader has to know of forces."""


def states_forces(grasps: GraspBatch) -> bool:
    """Whether any force is known of any grasp."""
    return any(bool(column.isfinite().any()) for column in (grasps.payload, grasps.squeeze_force, grasps.squeeze_torque))


def on_one_line(text: str) -> str:
    """Text for a comment, in which names stand as they were given: without line breaks and other control characters."""
    return "".join(c if c.isprintable() else " " for c in text)


def comment(grasps: GraspBatch, frame: Frame) -> str:
    """Three lines that a reader of the file needs: hand, frame, units and the meaning of numbers."""
    named = on_one_line(f"Grasps by hand '{grasps.hand}': poses of link '{grasps.wrist_link}' in {frame.sentence(grasps)}.")
    return (
        f"# {named}\n"
        "# Metres and radians; quaternions by name or WXYZ. Joints are the independent ones; mimic joints follow them.\n"
        "# Score: predicted log-odds that the grasp holds; confidence is its logistic function. Energy: lower is better."
        f"{f' {FORCES}' if states_forces(grasps) else ''}\n"
    )


def forces(grasps: GraspBatch, i: int) -> dict[str, float]:
    """Payload [kg] and squeeze force [N] of a grasp, and the object's weight [N], as far as they are known."""
    known = {name: getattr(grasps, name) for name in columns.CARRYING}
    known |= {name: column for name, column in grasps.extra.items() if name == WEIGHT_COLUMN}
    return {name: plain(column[i:i + 1])[0] for name, column in known.items() if bool(column[i].isfinite())}


def hold(grasps: GraspBatch, i: int) -> dict[str, Float[Tensor, " n_dof"]]:
    """Joints and efforts to expect of a grasp with the object in the hand and without, where `expect_hold` has found them."""
    told = HoldExpectation.of(grasps, i) is not None
    return {name: grasps.extra[name][i] for name in HOLD_COLUMNS[:4]} if told else {}


def plain(values: Float[Tensor, " k"]) -> list[float]:
    """Numbers that read well: a ten-millionth is finer than any robot."""
    return [round(float(v), 7) for v in values]


def yaml_text(content: Any) -> str:
    """YAML in the order given, leaves on one line."""
    return yaml.dump(content, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=120, allow_unicode=True)


class _Dumper(yaml.SafeDumper):
    """Without anchors, which other readers do not expect."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


NO_CONFIDENCE = 0.5
"""Confidence of a grasp without a score: neither good nor bad (ours). The documented format lists the entry for every grasp,
and readers may rely on it."""


def isaac_grasp(grasps: GraspBatch, frame: Frame, hand: Hand | None = None) -> str:
    """An isaac_grasp YAML file (version 1.0) of grasps of one object, with pregrasps.

    Of forces the format knows nothing: `squeeze_cspace_position`, `squeeze_cspace_effort`, `payload`, `squeeze_force` and
    what is expected of a hold (HOLD_COLUMNS) are further entries, which its readers hand on or skip. Source: documentation
    of isaac_grasp files in Isaac Sim (grasp editor) and Isaac ROS.
    """
    position, quaternion = frame.place(grasps)
    joints, efforts = postures(grasps), squeeze_efforts(grasps, hand)
    entries, unknown, names = {}, 0, grasps.joint_names
    for i in range(len(grasps)):
        w, *xyz = plain(quaternion[i])
        stated = confidence(grasps, i)
        unknown += stated is None
        entries[f"grasp_{i}"] = {
            "confidence": NO_CONFIDENCE if stated is None else stated, "position": plain(position[i]),
            "orientation": {"w": w, "xyz": xyz}, "cspace_position": dict(zip(names, plain(grasps.joints[i]), strict=True)),
            "pregrasp_cspace_position": dict(zip(names, plain(joints["pregrasp"][i]), strict=True)),
            "squeeze_cspace_position": dict(zip(names, plain(joints["squeeze"][i]), strict=True)),
        }
        if (effort := efforts_of(efforts, i)) is not None:
            entries[f"grasp_{i}"]["squeeze_cspace_effort"] = dict(zip(names, plain(effort), strict=True))
        entries[f"grasp_{i}"] |= {name: dict(zip(names, plain(row), strict=True)) for name, row in hold(grasps, i).items()}
        entries[f"grasp_{i}"] |= forces(grasps, i)
    content = {"format": "isaac_grasp", "format_version": 1.0, "object_frame_link": frame.name_for(grasps),
               "gripper_frame_link": grasps.wrist_link, "grasps": entries}
    note = f"# {unknown} of {len(grasps)} grasps have no score: their confidence {NO_CONFIDENCE} stands for unknown.\n"
    return comment(grasps, frame) + (note if unknown else "") + yaml_text(content)


APPROACH = 0.10  # Wished path of the hand along its palm direction before the grasp [m] (ours)
RETREAT = 0.10  # Wished path away from the grasp [m] (ours)
SHORTEST = 0.02  # Least path of either [m] (ours)
NO_LIMIT = 0.0  # `max_contact_force` that limits nothing. Source: moveit_msgs/Grasp


def moveit_grasps(grasps: GraspBatch, hand: Hand, frame: Frame) -> str:
    """A YAML list of moveit_msgs/Grasp, with the wrist link's pose, the fingers' postures and the efforts of the squeeze.

    The hand approaches along its palm direction and retreats along z of the frame, which is up in a robot's base. A grasp
    without a score has no `grasp_quality`, and one without known efforts an empty `effort`. Payloads and HOLD_COLUMNS, which
    have no place in it, stand in comments. Source: moveit_msgs/Grasp of MoveIt 2, whose `grasp_posture` is of positions and
    efforts.
    """
    position, quaternion = frame.place(grasps)
    joints, efforts = postures(grasps), squeeze_efforts(grasps, hand)
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
            "grasp_posture": _posture(grasps, at_wrist, joints["squeeze"][i], efforts_of(efforts, i)),
            "grasp_pose": {"header": header, "pose": pose}, **({} if quality is None else {"grasp_quality": quality}),
            "pre_grasp_approach": _path(at_wrist, palm, APPROACH),
            "post_grasp_retreat": _path(header, torch.tensor([0.0, 0.0, 1.0]), RETREAT),
            "post_place_retreat": _path(at_wrist, -palm, RETREAT),
            "max_contact_force": forces(grasps, i).get("squeeze_force", NO_LIMIT), "allowed_touch_objects": [grasps.object[i]],
        })
    return comment(grasps, frame) + _payloads(grasps) + _holds(grasps) + yaml_text(messages)


def _payloads(grasps: GraspBatch) -> str:
    """A comment line with the payload of each grasp; nothing if none is known."""
    if not bool(grasps.payload.isfinite().any()):
        return ""
    told = (str(forces(grasps, i).get("payload", "unknown")) for i in range(len(grasps)))
    return f"# Payload of each grasp in kg: {', '.join(told)}\n"


def _holds(grasps: GraspBatch) -> str:
    """Comment lines with what to expect of a hold, for each grasp: joints and efforts in the joints' order, and the weight."""
    lines = list[str]()
    for i in range(len(grasps)):
        lines += [f"# grasp_{i} {name}: {', '.join(map(str, plain(row)))}\n" for name, row in hold(grasps, i).items()]
        lines += [f"# grasp_{i} {name}: {weight}\n" for name, weight in forces(grasps, i).items() if name == WEIGHT_COLUMN]
    return "".join(lines)


def _posture(
    grasps: GraspBatch, header: dict[str, Any], joints: Float[Tensor, " n_dof"], effort: Float[Tensor, " n_dof"] | None = None
) -> dict[str, Any]:
    """A trajectory_msgs/JointTrajectory of one point."""
    point = {"positions": plain(joints), "velocities": [], "accelerations": [],
             "effort": [] if effort is None else plain(effort), "time_from_start": {"sec": 0, "nanosec": 0}}
    return {"header": header, "joint_names": list(grasps.joint_names), "points": [point]}


def _path(header: dict[str, Any], direction: Float[Tensor, "3"], wished: float) -> dict[str, Any]:
    """A moveit_msgs/GripperTranslation."""
    return {"direction": {"header": header, "vector": dict(zip("xyz", plain(direction), strict=True))},
            "desired_distance": wished, "min_distance": SHORTEST}


def dexgraspbench(
    grasps: GraspBatch, frame: Frame, object_path: str, scale: float, hand: Hand | None = None
) -> list[dict[str, Any]]:
    """One dictionary per grasp, as DexGraspBench reads it from a npy file.

    Postures are wrist pose (x y z, qw qx qy qz) and joints in one row; `obj_pose` is the pose of the object's file in their
    frame, WXYZ as well. `squeeze_effort`, `payload`, `squeeze_force` and HOLD_COLUMNS are of ours, where known. Source:
    readme of DexGraspBench.
    """
    position, quaternion = frame.place(grasps)
    joints, efforts = postures(grasps), squeeze_efforts(grasps, hand)
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
            "units": "m, rad, kg, N, Nm", **forces(grasps, i),
        })
        if (effort := efforts_of(efforts, i)) is not None:
            found[-1]["squeeze_effort"] = effort.double().numpy()
        found[-1] |= {name: row.double().numpy() for name, row in hold(grasps, i).items()}
    return found


def csv_table(grasps: GraspBatch, frame: Frame, hand: Hand | None = None) -> str:
    """One line per grasp: pose, score, energy, outcome, forces, and joints of all postures and efforts, after comment lines."""
    position, quaternion = frame.place(grasps)
    joints, efforts = postures(grasps), squeeze_efforts(grasps, hand)
    text = io.StringIO()
    text.write(comment(grasps, frame))
    writer = csv.writer(text, lineterminator="\n")
    told = HOLD_COLUMNS[:4] if all(name in grasps.extra for name in HOLD_COLUMNS) else ()
    weight = [grasps.extra[WEIGHT_COLUMN]] if WEIGHT_COLUMN in grasps.extra else []
    names = [f"{posture}:{joint}" for posture in (*joints, "effort", *told) for joint in grasps.joint_names]
    writer.writerow(["object", "x", "y", "z", "qw", "qx", "qy", "qz", "score", "energy", "success", "protocol",
                     "robustness", "fingers_in_contact", *columns.CARRYING, *names, *[WEIGHT_COLUMN] * len(weight)])
    for i in range(len(grasps)):
        writer.writerow([
            grasps.object[i], *plain(position[i]), *plain(quaternion[i]), _cell(grasps.score[i]), _cell(grasps.energy[i]),
            int(grasps.success[i]) if bool(grasps.evaluated[i]) else "", grasps.protocol[i],
            *(_cell(getattr(grasps, name)[i]) for name in ("robustness", "fingers_in_contact", *columns.CARRYING)),
            *(value for values in joints.values() for value in plain(values[i])), *map(_cell, efforts[i]),
            *(_cell(value) for name in told for value in grasps.extra[name][i]), *(_cell(column[i]) for column in weight),
        ])
    return text.getvalue()


def _cell(value: Float[Tensor, ""]) -> float | str:
    """A number, or an empty cell where it is unknown."""
    return plain(value[None])[0] if bool(value.isfinite()) else ""


def _dexgraspbench_files(job: ExportJob) -> list[bytes]:
    files = []
    for entry in dexgraspbench(job.grasps, job.frame, job.object_path, job.object_scale, job.hand):
        file = io.BytesIO()
        np.save(file, np.array(entry, dtype=object), allow_pickle=True)
        files.append(file.getvalue())
    return files


def _moveit_file(job: ExportJob) -> bytes:
    if job.hand is None:
        raise OptionError("MoveIt messages state the palm direction: give the hand of the grasps")
    return moveit_grasps(job.grasps, job.hand, job.frame).encode()


def _usd_file(job: ExportJob) -> bytes:
    from dro_grasp.grasps.export.usd import usd_file  # it needs an extra

    return usd_file(job)


WRITERS: dict[str, Callable[[ExportJob], bytes | list[bytes]]] = {
    "isaac_grasp": lambda job: isaac_grasp(job.grasps, job.frame, job.hand).encode(),
    "moveit": _moveit_file,
    "dexgraspbench": _dexgraspbench_files,
    "csv": lambda job: csv_table(job.grasps, job.frame, job.hand).encode(),
    "usd": _usd_file,
}
"""What makes one object's file, or one file per grasp, by the format's name."""
