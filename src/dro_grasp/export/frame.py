"""The frame that exported poses are given in."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import roma
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.frames import read_motion
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
        """This frame's name; the object's own frame has the name that its grasps give it, or else the object's."""
        return self.name if self.name != OBJECT else frame_of(grasps) or grasps.object[0]

    def sentence(self, grasps: GraspBatch) -> str:
        """This frame in words."""
        own = self.name == OBJECT and frame_of(grasps) is None
        return f"the mesh frame of object '{grasps.object[0]}'" if own else f"frame '{self.name_for(grasps)}'"
