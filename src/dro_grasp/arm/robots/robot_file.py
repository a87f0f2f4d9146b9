"""What a robot file says, each entry read and checked by itself; errors name the file and the entry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
import yaml
from jaxtyping import Float

from dro_grasp.arm.robots.robot import CameraMount, Table
from dro_grasp.errors import RobotError
from dro_grasp.files import given_path
from dro_grasp.frames import motion_fault
from dro_grasp.geometry.rendering.rasterizer import Camera
from dro_grasp.geometry.se3 import roma
from dro_grasp.hands.description.loader import named, split_part
from dro_grasp.kinds import is_number

Read = TypeVar("Read")
POSE_KEYS = {"position", "quaternion_wxyz"}  # What a robot file states of a pose
DRIVER_KEYS = ("zeros", "signs", "units")  # What a robot file states of drivers, each by joint
FARTHEST_MOUNT = 2.0  # Largest distance of a hand from the link that carries it [m] (ours)


class Faults:
    """Collects what is wrong with a robot file, and says it all at the end of its block."""

    def __init__(self, path: Path) -> None:
        self.path, self.found = path, list[str]()

    def of(self, read: Callable[[], Read], otherwise: Read) -> Read:
        """What is read; another value, with the fault noted, where that is refused."""
        try:
            return read()
        except RobotError as error:
            self._note(error)
            return otherwise

    def _note(self, error: RobotError) -> None:
        self.found.append(str(error).removeprefix(f"{self.path}: "))

    def __enter__(self) -> Faults:
        return self

    def __exit__(self, kind: object, error: BaseException | None, _: object) -> None:
        if isinstance(error, RobotError):
            self._note(error)
        if self.found and (error is None or isinstance(error, RobotError)):
            raise RobotError(f"{self.path}: {'; '.join(dict.fromkeys(self.found))}") from error


class RobotFile:
    """What a robot file says, with the file and the entry named in errors; nothing is compared with arm and hand yet."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            values = yaml.safe_load(path.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:  # of values such as the date 2024-99-99, too
            raise RobotError(f"{path} cannot be read as YAML: {' '.join(str(error).split())}") from error
        known = {"name", "arm", "hand", "mount", "base", "home", "limits", "hand_limits", "camera", "table", *DRIVER_KEYS}
        values = self.mapping(values, "the file", known, {"arm", "hand"})
        self.name, self.arm = str(values.get("name", path.stem)), path.parent / given_path(str(values["arm"]))
        if not self.name.isprintable() or not self.name.strip(" .") or "/" in self.name:
            raise self.error(f"the name is {self.name!r}; files are called by it, so give letters, digits, spaces, '-' or '_'")
        hand = str(values["hand"])
        file, link = split_part(str(path.parent / hand))
        self.hand = named(file, link) if given_path(file).is_file() else hand
        faults = self.faults = Faults(path)
        self.mount = faults.of(lambda: self._mount(values), {"faulty": True})
        self.T_link_wrist = faults.of(lambda: self.pose(self.mount, "mount", FARTHEST_MOUNT), np.eye(4))
        self.T_world_base = faults.of(
            lambda: self.pose(self.mapping(values.get("base", {}), "base", POSE_KEYS), "base"), np.eye(4))
        self.home = faults.of(lambda: self._home(values.get("home")), None)
        self.limits = faults.of(lambda: self.mapping(
            values.get("limits", {}), "limits", {"velocity", "acceleration", "effort", "position"}), {})
        self.hand_limits = faults.of(lambda: self.mapping(
            values.get("hand_limits", {}), "hand_limits", {"velocity", "acceleration"}), {})
        self.camera = faults.of(lambda: self._camera(values.get("camera")), None)
        self.table = faults.of(lambda: self._table(values.get("table")), None)
        self.drivers = {key: faults.of(lambda key=key: self.mapping(values.get(key, {}), key), {}) for key in DRIVER_KEYS}

    def _mount(self, values: dict[Any, Any]) -> dict[Any, Any]:
        return self.mapping(values["mount"], "mount", {"link", *POSE_KEYS}, {"link"}) if "mount" in values else {}

    def _home(self, stated: Any) -> dict[str, float] | None:
        """Home by joint; None where the file leaves it to a key of the arm's file."""
        if stated is None:
            return None
        return {str(k): self.number(v, f"home of joint {k}") for k, v in self.mapping(stated, "home").items()}

    def error(self, text: str) -> RobotError:
        """An error that names the file."""
        return RobotError(f"{self.path}: {text}")

    def mapping(self, value: Any, what: str, known: set[str] | None = None, needed: set[str] | None = None) -> dict[Any, Any]:
        """An entry of entries, all of them known, the needed ones there."""
        if not isinstance(value, dict):
            raise self.error(f"{what} is {value!r}; expected entries 'name: value'")
        if known is not None and (extra := [k for k in value if k not in known]):
            raise self.error(f"{what} has an entry '{extra[0]}'; known are {', '.join(sorted(known))}")
        if missing := sorted((needed or set()) - set(value)):
            raise self.error(f"{what} lacks the {'entries' if missing[1:] else 'entry'} {quoted(missing)}")
        return value

    def number(self, value: Any, what: str) -> float:
        """A finite number."""
        if not is_number(value):
            raise self.error(f"{what} is {value!r}; expected a number")
        return float(value)

    def positive(self, value: Any, what: str) -> float:
        """A number above 0."""
        if (number := self.number(value, what)) <= 0:
            raise self.error(f"{what} is {number:g}; expected a number above 0")
        return number

    def pixels(self, value: Any, what: str) -> int:
        """A whole number above 0."""
        if (number := self.positive(value, what)) % 1:
            raise self.error(f"{what} is {number:g}; expected a whole number of pixels")
        return int(number)

    def numbers(self, value: Any, what: str, count: int) -> list[float]:
        """So many numbers in brackets."""
        if not isinstance(value, list | tuple) or len(value) != count:
            raise self.error(f"{what} is {value!r}; expected {count} numbers in brackets")
        return [self.number(v, what) for v in value]

    def pose(self, values: dict[str, Any], what: str, farthest: float = np.inf) -> Float[np.ndarray, "4 4"]:
        """A pose [m] from `position` and `quaternion_wxyz`; no farther than that from the origin."""
        T = np.eye(4)
        T[:3, 3] = self.numbers(values.get("position", [0, 0, 0]), f"{what}: position", 3)
        if (far := float(np.linalg.norm(T[:3, 3]))) > farthest:
            raise self.error(f"{what}: position is {far:g} m off, as of millimetres; expected at most {farthest:g} m")
        wxyz = np.array(self.numbers(values.get("quaternion_wxyz", [1, 0, 0, 0]), f"{what}: quaternion_wxyz", 4))
        if abs(float(np.linalg.norm(wxyz)) - 1) > 1e-3:
            raise self.error(f"{what}: quaternion_wxyz has length {np.linalg.norm(wxyz):g}; expected 1")
        unit = torch.from_numpy(wxyz / np.linalg.norm(wxyz))
        T[:3, :3] = roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(unit)).numpy()
        if (fault := motion_fault(torch.from_numpy(T))) is not None:
            raise self.error(f"{what}: {fault}")
        return T

    def _camera(self, values: Any) -> CameraMount | None:
        if values is None:
            return None
        known = {*POSE_KEYS, "target", "T_world_camera", "width", "height", "focal", "centre"}
        values = self.mapping(values, "camera", known, {"focal"})
        if "T_world_camera" in values:
            try:
                T = torch.tensor(values["T_world_camera"], dtype=torch.float64)
            except (TypeError, ValueError) as error:
                raise self.error(f"camera: T_world_camera is no matrix of numbers ({error}); expected 4 rows of 4") from error
            if (fault := motion_fault(T)) is not None:
                raise self.error(f"camera: T_world_camera is no rigid motion: {fault}")
            pose = T.numpy()
        elif "target" in values:
            pose = self._looking(values)
        else:
            pose = self.pose(values, "camera")
        width, height = (self.pixels(values.get(k, d), f"camera: {k}") for k, d in (("width", 640), ("height", 480)))
        focal = self.positive(values["focal"], "camera: focal")
        x, y = self.numbers(values.get("centre", [(width - 1) / 2, (height - 1) / 2]), "camera: centre", 2)
        return CameraMount(pose, np.array([[focal, 0.0, x], [0.0, focal, y], [0.0, 0.0, 1.0]]), width, height)

    def _looking(self, values: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
        """The pose of a camera at `position` that looks at `target`, with the world's z up in its picture."""
        position, target = (self.numbers(values.get(k), f"camera: {k}", 3) for k in ("position", "target"))
        if np.allclose(position, target):
            raise self.error("camera: position and target are the same point; expected a direction between them")
        axes = Camera((position[0], position[1], position[2]), (target[0], target[1], target[2])).axes()
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.stack([axes[0], -axes[1], -axes[2]], 1), position
        return T

    def _table(self, values: Any) -> Table | None:
        if values is None:
            return None
        values = self.mapping(values, "table", {"height", "centre", "size"})
        default = Table()
        x, y = self.numbers(values.get("centre", list(default.centre)), "table: centre", 2)
        length, width = self.numbers(values.get("size", list(default.size)), "table: size", 2)
        if min(length, width) <= 0:
            raise self.error(f"table: size is {[length, width]}; expected metres above 0")
        return Table(self.number(values.get("height", 0.0), "table: height"), (x, y), (length, width))


def quoted(names: Sequence[str]) -> str:
    """Names in quotation marks, in words."""
    return " and ".join(f"'{name}'" for name in names)
