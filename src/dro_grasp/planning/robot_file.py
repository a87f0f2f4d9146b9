"""`robot.yaml`: an arm, a hand, where one is mounted on the other, and what stands around them."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from jaxtyping import Float

from dro_grasp.descriptions.part import named, split_part
from dro_grasp.errors import RobotError
from dro_grasp.files import given_path
from dro_grasp.frames import motion_fault
from dro_grasp.geometry.se3 import roma
from dro_grasp.rendering.rasterizer import Camera

BUILTIN_ROBOTS = Path(__file__).parent / "builtin"
"""Folder of the built-in robots."""
LIMITS = {"velocity", "acceleration", "effort", "position"}
"""What may be stated of the arm's joints."""
KEYS = {"name", "arm", "hand", "mount", "base", "home", "limits", "hand_limits", "camera", "table"}
"""What a robot file may state."""
POSE_KEYS = {"position", "quaternion_wxyz"}
"""What it states of a pose."""
CAMERA_KEYS = {*POSE_KEYS, "target", "T_world_camera", "width", "height", "focal", "centre"}
"""What it may state of the camera."""


@dataclass(frozen=True)
class CameraMount:
    """A depth camera that stands still. Its z axis points forward, x right and y down."""

    T_world_camera: Float[np.ndarray, "4 4"]
    """Pose [m]."""
    intrinsics: Float[np.ndarray, "3 3"]
    """Focal lengths and principal point [pixels]."""
    width: int = 640
    """[pixels]"""
    height: int = 480
    """[pixels]"""


@dataclass(frozen=True)
class Table:
    """A level rectangle that everything stands on."""

    height: float = 0.0
    """z of its upper side in the world [m]."""
    centre: tuple[float, float] = (0.45, 0.0)
    """Its middle in the world [m]."""
    size: tuple[float, float] = (1.2, 1.4)
    """Extent along x and y [m]."""


@dataclass(frozen=True)
class RobotFile:
    """What a robot file says; nothing of it has been compared with arm and hand yet."""

    path: Path
    name: str
    arm: Path
    """URDF or MJCF file of the arm."""
    hand: str
    """Name or file of the hand."""
    mount_link: str | None
    """The arm's link that carries the hand; None if the file does not say it."""
    T_link_wrist: Float[np.ndarray, "4 4"]
    """Pose of the hand's root link in the mount link [m]."""
    T_world_base: Float[np.ndarray, "4 4"]
    """Pose of the arm's root link in the world [m]."""
    home: Mapping[str, float]
    """Where each joint of the arm starts [rad or m]."""
    limits: Mapping[str, Any]
    """Of the arm's joints, by LIMITS: one number for all, or numbers by joint."""
    hand_velocity: float
    """Of the hand's joints [rad/s or m/s]."""
    hand_acceleration: float
    """Of the hand's joints [rad/s^2 or m/s^2]."""
    camera: CameraMount | None
    table: Table | None


def locate_robot(name: str | Path) -> Path:
    """The file of a built-in robot, or the path that is given.

    Raises:
        RobotError: There is neither.
    """
    path, builtin = given_path(name), BUILTIN_ROBOTS / f"{name}.yaml"
    if "/" not in str(name) and builtin.is_file():
        return builtin
    if not path.is_file():
        raise RobotError(f"no robot is called '{name}' and no file is there; give a robot.yaml, or one of "
                         f"{', '.join(robot_names())}")
    return path


def robot_names() -> list[str]:
    """Names of the built-in robots."""
    return sorted(file.stem for file in BUILTIN_ROBOTS.glob("*.yaml"))


def read_robot_file(path: Path) -> RobotFile:
    """Read a robot file.

    Raises:
        RobotError: It is no such file; the message names the entry and what it should be.
    """
    try:
        values = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise RobotError(f"{path} cannot be read as YAML: {' '.join(str(error).split())}") from error
    read = _Reader(path)
    values = read.mapping(values, "the file", KEYS, {"arm", "hand", "home"})
    mount = read.mapping(values["mount"], "mount", {"link", *POSE_KEYS}, {"link"}) if "mount" in values else {}
    hand_limits = read.mapping(values.get("hand_limits", {}), "hand_limits", {"velocity", "acceleration"})
    hand = str(values["hand"])
    file, link = split_part(str(path.parent / hand))
    return RobotFile(
        path, str(values.get("name", path.stem)), path.parent / given_path(str(values["arm"])),
        named(file, link) if Path(file).is_file() else hand, str(mount["link"]) if mount else None, read.pose(mount, "mount"),
        read.pose(read.mapping(values.get("base", {}), "base", POSE_KEYS), "base"),
        {str(k): read.number(v, f"home of joint {k}") for k, v in read.mapping(values["home"], "home").items()},
        read.mapping(values.get("limits", {}), "limits", LIMITS),
        read.positive(hand_limits.get("velocity", 2.0), "hand_limits: velocity"),
        read.positive(hand_limits.get("acceleration", 10.0), "hand_limits: acceleration"),
        read.camera(values.get("camera")), read.table(values.get("table")))


def is_number(value: Any) -> bool:
    """Whether an entry of a robot file is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


class _Reader:
    """Reads entries, and names the file and the entry in errors."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def error(self, text: str) -> RobotError:
        return RobotError(f"{self.path}: {text}")

    def mapping(self, value: Any, what: str, known: set[str] | None = None, needed: set[str] | None = None) -> dict[Any, Any]:
        if not isinstance(value, dict):
            raise self.error(f"{what} is {value!r}; expected entries 'name: value'")
        if known is not None and (extra := [k for k in value if k not in known]):
            raise self.error(f"{what} has an entry '{extra[0]}'; known are {', '.join(sorted(known))}")
        if missing := sorted((needed or set()) - set(value)):
            raise self.error(f"{what} lacks the entry '{missing[0]}'")
        return value

    def number(self, value: Any, what: str) -> float:
        if not is_number(value):
            raise self.error(f"{what} is {value!r}; expected a number")
        return float(value)

    def positive(self, value: Any, what: str) -> float:
        if (number := self.number(value, what)) <= 0:
            raise self.error(f"{what} is {number:g}; expected a number above 0")
        return number

    def numbers(self, value: Any, what: str, count: int) -> list[float]:
        if not isinstance(value, list | tuple) or len(value) != count:
            raise self.error(f"{what} is {value!r}; expected {count} numbers in brackets")
        return [self.number(v, what) for v in value]

    def pose(self, values: dict[str, Any], what: str) -> Float[np.ndarray, "4 4"]:
        T = np.eye(4)
        T[:3, 3] = self.numbers(values.get("position", [0, 0, 0]), f"{what}: position", 3)
        wxyz = np.array(self.numbers(values.get("quaternion_wxyz", [1, 0, 0, 0]), f"{what}: quaternion_wxyz", 4))
        if abs(float(np.linalg.norm(wxyz)) - 1) > 1e-3:
            raise self.error(f"{what}: quaternion_wxyz has length {np.linalg.norm(wxyz):g}; expected 1")
        unit = torch.from_numpy(wxyz / np.linalg.norm(wxyz))
        T[:3, :3] = roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(unit)).numpy()
        if (fault := motion_fault(torch.from_numpy(T))) is not None:
            raise self.error(f"{what}: {fault}")
        return T

    def camera(self, values: Any) -> CameraMount | None:
        if values is None:
            return None
        values = self.mapping(values, "camera", CAMERA_KEYS, {"focal"})
        if "T_world_camera" in values:
            try:
                T = torch.tensor(values["T_world_camera"], dtype=torch.float64)
            except (TypeError, ValueError) as error:
                raise self.error(f"camera: T_world_camera is no matrix of numbers ({error}); expected 4 rows of 4") from error
            if (fault := motion_fault(T)) is not None:
                raise self.error(f"camera: T_world_camera is no rigid motion: {fault}")
            pose = T.numpy()
        elif "target" in values:
            pose = self.looking(values)
        else:
            pose = self.pose(values, "camera")
        width, height = (int(self.positive(values.get(k, d), f"camera: {k}")) for k, d in (("width", 640), ("height", 480)))
        focal = self.positive(values["focal"], "camera: focal")
        x, y = self.numbers(values.get("centre", [(width - 1) / 2, (height - 1) / 2]), "camera: centre", 2)
        return CameraMount(pose, np.array([[focal, 0.0, x], [0.0, focal, y], [0.0, 0.0, 1.0]]), width, height)

    def looking(self, values: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
        """The pose of a camera at `position` that looks at `target`, with the world's z up in its picture."""
        position, target = (self.numbers(values.get(k), f"camera: {k}", 3) for k in ("position", "target"))
        if np.allclose(position, target):
            raise self.error("camera: position and target are the same point; expected a direction between them")
        axes = Camera((position[0], position[1], position[2]), (target[0], target[1], target[2])).axes()
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.stack([axes[0], -axes[1], -axes[2]], 1), position
        return T

    def table(self, values: Any) -> Table | None:
        if values is None:
            return None
        values = self.mapping(values, "table", {"height", "centre", "size"})
        default = Table()
        x, y = self.numbers(values.get("centre", list(default.centre)), "table: centre", 2)
        length, width = self.numbers(values.get("size", list(default.size)), "table: size", 2)
        if min(length, width) <= 0:
            raise self.error(f"table: size is {[length, width]}; expected metres above 0")
        return Table(self.number(values.get("height", 0.0), "table: height"), (x, y), (length, width))
