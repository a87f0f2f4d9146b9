"""What several formats say about grasps, in which frame, and how they write it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import yaml
from jaxtyping import Float
from torch import Tensor

from dro_grasp.errors import OptionError
from dro_grasp.frames import is_name, motion_fault, read_motion
from dro_grasp.geometry.se3 import roma
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.sources import frame_of

OBJECT = "object"
"""Name of the frame that grasps are stored in: that of the object's mesh or cloud."""


@dataclass(frozen=True)
class Frame:
    """The frame that poses are given in."""

    name: str = OBJECT
    T_frame_object: Float[Tensor, "4 4"] = field(default_factory=lambda: torch.eye(4))
    """Takes coordinates of the object's frame to this one [m]."""

    def __post_init__(self) -> None:
        """Refuse names that would break the files, and what is no rigid motion.

        Raises:
            OptionError: As said.
        """
        if not is_name(self.name):
            raise OptionError(f"the frame is called {self.name!r}; expected a name on one line, without control characters")
        if (fault := motion_fault(self.T_frame_object)) is not None:
            raise OptionError(f"T_frame_object of frame '{self.name}' must be a rigid motion, in metres; {fault}")

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
        """This frame in words."""
        own = self.name == OBJECT and frame_of(grasps) is None
        return f"{'the mesh frame of object' if own else 'frame'} '{self.name_for(grasps)}'"


def postures(grasps: GraspBatch) -> dict[str, Float[Tensor, "n n_dof"]]:
    """Joints of pregrasp, grasp and squeeze, in the order in which a hand goes through them [rad or m].

    Raises:
        OptionError: A grasp states no pregrasp or squeeze.
    """
    if not bool(grasps.states_closing.all()):
        raise OptionError("these grasps have no pregrasp and squeeze; `dro-grasp export` makes them, and so does "
                          "`dro_grasp.complete(problem, grasps)`")
    return {"pregrasp": grasps.pregrasp_joints, "grasp": grasps.joints, "squeeze": grasps.squeeze_joints}


def confidence(grasps: GraspBatch, i: int) -> float | None:
    """Predicted probability that a grasp holds, as files state it; None without a score."""
    known = float(grasps.confidence[i])
    return None if math.isnan(known) else round(known, 6)


def comment(grasps: GraspBatch, frame: Frame) -> str:
    """Three lines that a reader of the file needs: hand, frame, units and the meaning of numbers."""
    named = f"Grasps by hand '{grasps.hand}': poses of link '{grasps.wrist_link}' in {frame.sentence(grasps)}."
    return (
        f"# {''.join(c if c.isprintable() else ' ' for c in named)}\n"
        "# Metres and radians; quaternions by name or WXYZ. Joints are the independent ones; mimic joints follow them.\n"
        "# Score: predicted log-odds that the grasp holds; confidence is its logistic function. Energy: lower is better.\n"
    )


def by_joint(grasps: GraspBatch, joints: Float[Tensor, " n_dof"]) -> dict[str, float]:
    """Joint values by name."""
    return dict(zip(grasps.joint_names, plain(joints), strict=True))


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
