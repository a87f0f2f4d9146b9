"""A robot: an arm that carries a hand, ready for planning."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from dro_grasp.arm.robots.drivers import Drivers
from dro_grasp.errors import OptionError
from dro_grasp.hands.description.loader import Description
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.kinematics.tree import PRISMATIC, REVOLUTE, KinematicTree
from dro_grasp.kinds import flat
from dro_grasp.objects.perception.scene_files import SceneCamera

TURN = np.pi  # Planned motions stay this near home, so that configurations a whole turn apart count once [rad] (ours)
JointsLike = Sequence[float] | Real[np.ndarray, " n_arm"] | Real[Tensor, " n_arm"]


@dataclass(frozen=True)
class CameraMount:
    """A depth camera that stands still. Its z axis points forward, x right and y down."""

    T_world_camera: Float[np.ndarray, "4 4"]  # Pose [m]
    intrinsics: Float[np.ndarray, "3 3"]  # Focal lengths and principal point [pixels]
    width: int = 640  # [pixels]
    height: int = 480  # [pixels]

    def as_seen(self) -> SceneCamera:
        """The camera for `load_scene`."""
        return SceneCamera(self.T_world_camera, self.intrinsics, "world")

    def frames(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Which places of the world [m] are within its image; other things may hide them."""
        T, size = self.T_world_camera, np.array([self.width, self.height])
        image = (points - T[:3, 3]) @ T[:3, :3] @ self.intrinsics.T
        ahead = image[:, 2] > 0
        pixels = image[:, :2] / np.where(ahead, image[:, 2], 1.0)[:, None]
        return np.asarray(ahead & (pixels >= 0).all(1) & (pixels < size).all(1))


@dataclass(frozen=True)
class Table:
    """A level rectangle that everything stands on."""

    height: float = 0.0  # z of its upper side in the world [m]
    centre: tuple[float, float] = (0.45, 0.0)  # Its middle in the world [m]
    size: tuple[float, float] = (1.2, 1.4)  # Extent along x and y [m]


@dataclass(frozen=True, eq=False)
class Robot:
    """An arm with a hand. The world's z axis points up."""

    name: str
    """Name of the robot."""
    arm: Description
    """The arm's URDF or MJCF, as read."""
    hand: Hand
    """The hand that it carries."""
    mount_link: str
    """The arm's link that carries the hand."""
    T_link_wrist: Float[np.ndarray, "4 4"]
    """Pose of the hand's root link in the mount link [m]."""
    T_world_base: Float[np.ndarray, "4 4"]
    """Pose of the arm's root link in the world [m]."""
    home: Float[np.ndarray, " n_arm"]
    """Where the arm starts [rad or m]."""
    lower: Float[np.ndarray, " n_arm"]
    """Lower limits of the arm's joints [rad or m]."""
    upper: Float[np.ndarray, " n_arm"]
    """Upper limits [rad or m]."""
    velocity: Float[np.ndarray, " n_arm"]
    """Largest speed [rad/s or m/s]."""
    acceleration: Float[np.ndarray, " n_arm"]
    """Largest acceleration [rad/s^2 or m/s^2]."""
    effort: Float[np.ndarray, " n_arm"]
    """Largest torque or force [Nm or N]."""
    hand_velocity: Float[np.ndarray, " n_dof"]
    """Largest speed of the hand's joints [rad/s or m/s]."""
    hand_acceleration: Float[np.ndarray, " n_dof"]
    """Largest acceleration of the hand's joints [rad/s^2 or m/s^2]."""
    camera: CameraMount | None
    """A depth camera that stands still; None without one."""
    table: Table | None
    """The table that objects stand on; None without one."""
    drivers: Drivers
    """How the drivers of arm and hand count the joints."""
    source: str = ""
    """Name of a built-in robot, or the path of its file, from which it was loaded; empty where it was made otherwise."""

    @property
    def arm_joints(self) -> tuple[str, ...]:
        """Names of the arm's joints, from the base to the hand."""
        return tuple(self.arm.tree.joint_names)

    @property
    def hand_joints(self) -> tuple[str, ...]:
        """Names of the hand's independent joints."""
        return tuple(self.hand.tree.joint_names)

    @property
    def sha256(self) -> str:
        """Hash of all that motions depend on: robots of one hash are the same, whatever they and their files are called."""
        other = ("name", "source", "arm.", "hand.", "drivers")
        own = {name: value for name, value in flat(self).items() if not name.startswith(other)}
        stated = own | {"arm": self.arm.sha256, "hand": self.hand.sha256}
        return hashlib.sha256(json.dumps(stated, sort_keys=True, default=_rounded).encode()).hexdigest()

    @property
    def usual_table(self) -> Table:
        """The table; one of usual height and size where none is stated."""
        return self.table or Table()

    @property
    def working_range(self) -> tuple[Float[np.ndarray, " n_arm"], Float[np.ndarray, " n_arm"]]:
        """The joints' limits, and at most TURN from home."""
        return np.maximum(self.lower, self.home - TURN), np.minimum(self.upper, self.home + TURN)

    def require_start(self, start: JointsLike) -> Float[np.ndarray, " n_arm"]:
        """Joints of the arm at which a motion may begin [rad or m]; OptionError: they are others, or out of range."""
        found, names = np.asarray(start, np.float64), ", ".join(self.arm_joints)
        if found.shape != self.home.shape:
            raise OptionError(f"start has {found.size} values; robot '{self.name}' has {len(self.home)} arm joints: {names}")
        for name, q, *limits, low, high in zip(
            self.arm_joints, found, self.lower, self.upper, *self.working_range, strict=True):
            if not limits[0] <= q <= limits[1]:
                raise OptionError(f"start puts joint '{name}' at {q:.4g}, outside its limits {limits[0]:.4g} to "
                                  f"{limits[1]:.4g}; give radians or metres in the order {names}")
            if not low <= q <= high:
                raise OptionError(f"start puts joint '{name}' at {q:.4g}, more than half a turn from `home`, and plans stay "
                                  f"within {low:.4g} to {high:.4g}; turn it back, or state another `home`")
        return found

    def require_table(self, camera: bool = True) -> None:
        """Refuse a robot whose table is not known, or whose camera is not, where it needs one, by an OptionError."""
        missing = "table" if self.table is None else "camera" if camera and self.camera is None else None
        if missing is not None:
            raise OptionError(f"robot '{self.name}' has no {missing}; state it in the robot file: things lie on the table, and "
                              "the camera sees them")

    @property
    def open_hand(self) -> Float[np.ndarray, " n_dof"]:
        """The posture in which the hand travels [rad or m]."""
        with torch.no_grad():
            return self.hand.canonical_joints().double().numpy()

    @property
    def has_few_joints(self) -> bool:
        """Whether the arm brings its wrist to some poses only."""
        return len(self.home) < 6

    @property
    def T_wrist_aim(self) -> Float[np.ndarray, "4 4"]:
        """Pose in the hand's root link of the frame that the arm brings to its place [m]; of few joints the grasp centre's."""
        T = np.eye(4)
        if self.has_few_joints:
            T[:3, 3] = self.hand.grasp_centre_wrist.double().numpy()
        return T

    @property
    def longest_reach(self) -> float:
        """Largest distance of the grasp centre from the base [m]: all distances between joints, and the travel of slides."""
        return self._wrist_reach + float(self.hand.grasp_centre_wrist.norm())

    @property
    def full_reach(self) -> float:
        """Largest distance of any part of arm or hand from the base [m]."""
        assert self.hand.description is not None
        limits = self.hand.tree.lower.double().numpy(), self.hand.tree.upper.double().numpy()
        return max(_farthest_surface(self.arm, *self.working_range),
                   self._wrist_reach + _farthest_surface(self.hand.description, *limits))

    @property
    def _wrist_reach(self) -> float:
        tree = self.arm.tree
        return _farthest(tree, *self.working_range, tree.link_names.index(self.mount_link), self.T_link_wrist[None, :3, 3])

    def T_world_wrist(self, arm: Float[np.ndarray, "*batch n_arm"]) -> Float[np.ndarray, "*batch 4 4"]:
        """Pose of the hand's root link [m]."""
        tree = self.arm.tree.double
        links = tree.forward(torch.from_numpy(np.ascontiguousarray(arm, np.float64)))
        mount = links[..., tree.link_names.index(self.mount_link), :, :]
        return self.T_world_base @ mount.numpy() @ self.T_link_wrist


def _farthest(
    tree: KinematicTree, lower: Float[np.ndarray, " n_dof"], upper: Float[np.ndarray, " n_dof"], link: int,
    points: Float[np.ndarray, "n 3"],
) -> float:
    """No point in a link's frame [m] gets farther from the root link's origin than this [m], by the triangle inequality."""
    tree = tree.double
    coupling, offset = tree.link_coupling, tree.link_offset
    ends = torch.stack([coupling * torch.from_numpy(end).double() for end in (lower, upper)])
    travel = torch.stack([ends.amin(0).sum(-1), ends.amax(0).sum(-1)]).add(offset).abs().amax(0)
    reach, held = 0.0, torch.from_numpy(points).double()
    while link >= 0:
        turns = tree.kind[link] == REVOLUTE
        centre = tree.anchor[link] if turns else torch.zeros_like(tree.anchor[link])  # a turn keeps distances to this point
        reach += float((held - centre).norm(dim=-1).max()) + (float(travel[link]) if tree.kind[link] == PRISMATIC else 0.0)
        held = (tree.origin[link, :3, :3] @ centre + tree.origin[link, :3, 3])[None]
        link = tree.parent[link]
    return reach + float(held.norm())


def _farthest_surface(
    description: Description, lower: Float[np.ndarray, " n_dof"], upper: Float[np.ndarray, " n_dof"]
) -> float:
    """No shape of a description gets farther from its root link's origin than this [m]; limits are as for `_farthest`."""
    tree = description.tree
    return max((_farthest(tree, lower, upper, shape.link, shape.vertices) for shape in description.geometry), default=0.0)


def _rounded(values: Float[np.ndarray, "..."]) -> list[Any]:
    """For hashes: what machines compute differs in the last digits."""
    return (values.round(9) + 0.0).tolist()
