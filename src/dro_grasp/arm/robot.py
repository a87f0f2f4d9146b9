"""A robot: an arm that carries a hand, read from `robot.yaml`, compared with its arm, and ready for planning."""

from __future__ import annotations

import hashlib
import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import mujoco
import numpy as np
import torch
import yaml
from jaxtyping import Float

from dro_grasp.arm.drivers import ANGLES, LENGTHS, Drivers
from dro_grasp.errors import HandError, OptionError, RobotError
from dro_grasp.files import given_path
from dro_grasp.frames import motion_fault
from dro_grasp.geometry.rendering.rasterizer import Camera
from dro_grasp.geometry.se3 import roma
from dro_grasp.hands.description.compiling import MAX_TURN
from dro_grasp.hands.description.loader import Description, load_description, named, split_part
from dro_grasp.hands.description.reduction import NO_LIMITS
from dro_grasp.hands.description.xml_files import parse_xml
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.kinematics.tree import PRISMATIC, REVOLUTE, KinematicTree
from dro_grasp.hands.library import load_hand, locate_hand
from dro_grasp.kinds import flat
from dro_grasp.objects.perception.scene_files import SceneCamera

BUILTIN_ROBOTS = Path(__file__).parent / "builtin"  # Folder of the built-in robots
HOME_KEY = "home"  # Name that MJCF files give the key in which a robot waits, as those of MuJoCo Menagerie do
Read = TypeVar("Read")
POSE_KEYS = {"position", "quaternion_wxyz"}  # What a robot file states of a pose
DRIVER_KEYS = ("zeros", "signs", "units")  # What a robot file states of drivers, each by joint
FARTHEST_MOUNT = 2.0  # Largest distance of a hand from the link that carries it [m] (ours)
TURN = np.pi  # Planned motions stay this near home, so that configurations a whole turn apart count once [rad] (ours)


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
    hand_velocity: float
    """Largest speed of the hand's joints [rad/s or m/s]."""
    hand_acceleration: float
    """Largest acceleration of the hand's joints [rad/s^2 or m/s^2]."""
    camera: CameraMount | None
    """A depth camera that stands still; None without one."""
    table: Table | None
    """The table that objects stand on; None without one."""
    drivers: Drivers
    """How the drivers of arm and hand count the joints."""

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
        other = ("name", "arm.", "hand.", "drivers")
        own = {name: value for name, value in flat(self).items() if not name.startswith(other)}
        stated = own | {"arm": self.arm.sha256, "hand": self.hand.sha256}
        return hashlib.sha256(json.dumps(stated, sort_keys=True, default=_rounded).encode()).hexdigest()

    @property
    def working_range(self) -> tuple[Float[np.ndarray, " n_arm"], Float[np.ndarray, " n_arm"]]:
        """The joints' limits, and at most TURN from home."""
        return np.maximum(self.lower, self.home - TURN), np.minimum(self.upper, self.home + TURN)

    def require_start(self, start: Sequence[float] | Float[np.ndarray, " n"]) -> Float[np.ndarray, " n_arm"]:
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


def locate_robot(name: str | Path) -> Path:
    """The file of a built-in robot, or the path that is given."""
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


def load_robot(name: str | Path) -> Robot:
    """A built-in robot, or one from a robot file.

    Raises:
        RobotError: The file, its arm, or how the two fit; the message names the entry and a remedy.
        HandError: The hand cannot be used.
    """
    file = _RobotFile(locate_robot(name))
    with file.faults as faults:  # all at once, since each would cost its reader a round
        hand = locate_hand(file.hand)
        within = hand.link if hand.path.resolve() == file.arm.resolve() else None
        arm = _load_arm(file, within)
        fit = _Fit(file, arm, str(file.mount.get("link", within)))
        if "link" in file.mount or within is not None:
            faults.of(fit.check_tree, None)
        elif not file.mount:
            faults.found.append(f"the file lacks the entry 'mount'; state where the hand sits, or, if the arm's file has the "
                                f"hand, give it as a part of that: hand: {named(file.arm.name, 'LINK')}")
        none = np.zeros(len(fit.joints))
        lower, upper = faults.of(fit.positions, (none - np.inf, none + np.inf))
        home = faults.of(lambda: fit.home(lower, upper), none)
        loaded = load_hand(file.hand)
        drivers = faults.of(lambda: _drivers(file, arm, loaded), Drivers.usual(len(fit.joints)))
        velocity, acceleration, effort = (
            faults.of(lambda kind=kind, usual=usual: fit.limit(kind, usual), none)
            for kind, usual in (("velocity", None), ("acceleration", None), ("effort", 50.0)))
    return Robot(
        file.name, arm, loaded, fit.mount, file.T_link_wrist, file.T_world_base, home, lower, upper, velocity, acceleration,
        effort, file.hand_velocity, file.hand_acceleration, file.camera, file.table, drivers)


def _load_arm(file: _RobotFile, within: str | None) -> Description:
    try:
        return load_description(file.arm, within, arm=True)
    except HandError as error:
        path = str(file.arm)
        reason = path.join(re.sub(r"\bhand\b", "robot", part) for part in str(error).split(path))
        raise file.error(f"the arm cannot be used: {reason}") from error


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


class _RobotFile:
    """What a robot file says, with the file and the entry named in errors; nothing is compared with arm and hand yet."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            values = yaml.safe_load(path.read_text())
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
            raise RobotError(f"{path} cannot be read as YAML: {' '.join(str(error).split())}") from error
        known = {"name", "arm", "hand", "mount", "base", "home", "limits", "hand_limits", "camera", "table", *DRIVER_KEYS}
        values = self.mapping(values, "the file", known, {"arm", "hand"})
        self.name, self.arm = str(values.get("name", path.stem)), path.parent / given_path(str(values["arm"]))
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
        hand_limits = faults.of(lambda: self.mapping(
            values.get("hand_limits", {}), "hand_limits", {"velocity", "acceleration"}), {})
        self.hand_velocity, self.hand_acceleration = (
            faults.of(lambda kind=kind, usual=usual: self.positive(hand_limits.get(kind, usual), f"hand_limits: {kind}"), usual)
            for kind, usual in (("velocity", 2.0), ("acceleration", 10.0)))
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
        return RobotError(f"{self.path}: {text}")

    def mapping(self, value: Any, what: str, known: set[str] | None = None, needed: set[str] | None = None) -> dict[Any, Any]:
        if not isinstance(value, dict):
            raise self.error(f"{what} is {value!r}; expected entries 'name: value'")
        if known is not None and (extra := [k for k in value if k not in known]):
            raise self.error(f"{what} has an entry '{extra[0]}'; known are {', '.join(sorted(known))}")
        if missing := sorted((needed or set()) - set(value)):
            raise self.error(f"{what} lacks the {'entries' if missing[1:] else 'entry'} {_quoted(missing)}")
        return value

    def number(self, value: Any, what: str) -> float:
        if not _is_number(value):
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

    def pose(self, values: dict[str, Any], what: str, farthest: float = np.inf) -> Float[np.ndarray, "4 4"]:
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
        width, height = (int(self.positive(values.get(k, d), f"camera: {k}")) for k, d in (("width", 640), ("height", 480)))
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


def _quoted(names: Sequence[str]) -> str:
    return " and ".join(f"'{name}'" for name in names)


def _is_number(value: Any) -> bool:
    """Whether an entry of a robot file is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _drivers(file: _RobotFile, arm: Description, hand: Hand) -> Drivers:
    """What the file states of drivers, by the joints of arm and hand; one that both have is told apart as `hand/NAME`."""
    turns = [unit == 1 for tree in (arm.tree, hand.tree) for unit in tree.joint_unit.tolist()]
    names = [*arm.tree.joint_names, *hand.tree.joint_names]
    shared = set(arm.tree.joint_names) & set(hand.tree.joint_names)
    called = [f"{'arm' if i < arm.tree.n_dof else 'hand'}/{name}" if name in shared else name for i, name in enumerate(names)]
    for key, stated in file.drivers.items():
        if unknown := [str(name) for name in stated if name not in called]:
            raise file.error(f"{key} names joint '{unknown[0]}'; the joints of arm and hand are {', '.join(called)}")
    zeros = [file.number(file.drivers["zeros"].get(name, 0.0), f"zeros of joint {name}") for name in called]
    scales = [_sign(file, name) * _unit(file, name, ANGLES if turn else LENGTHS)
              for name, turn in zip(called, turns, strict=True)]
    return Drivers(tuple(zeros), tuple(scales))


def _sign(file: _RobotFile, name: str) -> float:
    sign = file.drivers["signs"].get(name, 1)
    if sign not in (1, -1) or isinstance(sign, bool):
        raise file.error(f"signs of joint {name} is {sign!r}; expected 1, or -1 where its driver counts the other way")
    return float(sign)


def _unit(file: _RobotFile, name: str, known: dict[str, float]) -> float:
    unit = file.drivers["units"].get(name, 1.0)
    if isinstance(unit, str) and unit in known:
        return known[unit]
    if isinstance(unit, str):
        whole = "metre" if known is LENGTHS else "radian"
        raise file.error(f"units of joint {name} is '{unit}'; expected {', '.join(known)}, or how many of them a {whole} has")
    return file.positive(unit, f"units of joint {name}")


class _Fit:
    """Compares a robot file with its arm."""

    def __init__(self, file: _RobotFile, arm: Description, mount: str) -> None:
        self.file, self.arm, self.tree, self.mount, self.error = file, arm, arm.tree, mount, file.error
        self.joints = list(self.tree.joint_names)

    def check_tree(self) -> None:
        """The mount link exists, and every joint of the arm moves it."""
        tree, link = self.tree, self.mount
        if link not in tree.link_names:
            raise self.error(f"the hand is mounted at link '{link}', which the arm does not have; its links are "
                             f"{', '.join(tree.link_names)}")
        if tree.joint_names != tree.moving_names:
            follower = next(n for n in tree.moving_names if n not in tree.joint_names)
            raise self.error(f"joint '{follower}' of the arm follows another; expected an arm of independent joints")
        if idle := [n for n, m in zip(self.joints, tree.moves[tree.link_names.index(link)].tolist(), strict=True) if not m]:
            raise self.error(f"joints {', '.join(idle)} of the arm do not move link '{link}'; remove what they move (a "
                             "gripper?) from the arm's file, or mount the hand farther out")
        reach = float(tree.forward(torch.zeros(tree.n_dof))[:, :3, 3].norm(dim=-1).max())
        if reach > 5.0:
            raise self.error(f"a link of the arm is {reach:.3g} m from its base, which looks like millimetres; expected metres")

    def positions(self) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Limits of the joints: the file's, or else the arm's."""
        stated = self._by_joint("position", self.file.limits.get("position", {}))
        unlimited = {note.subject for note in self.arm.notes if note.text.startswith(NO_LIMITS)}
        if missing := [name for name in self.joints if name in unlimited and name not in stated]:
            entries = ", ".join(f"{name}: [-3.1, 3.1]" for name in missing)
            raise self.error(f"{_joints(missing)} of the arm {_have(missing)} no position limits; state them in the "
                             f"arm's file, or here: "
                             f"limits: {{position: {{{entries}}}}}")
        lower, upper = (t.double().numpy().copy() for t in (self.tree.lower, self.tree.upper))
        for i, name in enumerate(self.joints):
            if name in stated:
                ends = stated[name]
                if not isinstance(ends, list) or len(ends) != 2 or not all(map(_is_number, ends)) or not ends[0] < ends[1]:
                    raise self.error(f"limits: position of joint '{name}' is {ends!r}; expected [lower, upper], numbers in rad "
                                     "or m")
                lower[i], upper[i] = ends
                if np.abs(ends).max() > MAX_TURN:
                    raise self.error(f"limits: position of joint '{name}' is {ends}, which looks like degrees: expected rad")
        return lower, upper

    def limit(self, kind: str, default: float | None = None) -> Float[np.ndarray, " n"]:
        """One limit of each joint: the file's, or else the arm's; only simulated servos use a default effort [Nm] (ours)."""
        given, stated = self.file.limits.get(kind), _stated_limits(self.arm.path, kind)
        if given is not None and not isinstance(given, dict):
            given = dict.fromkeys(self.joints, given)
        values = {**stated, **self._by_joint(kind, given or {})}
        if missing := [name for name in self.joints if values.get(name, default) is None]:
            raise self.error(f"{_joints(missing)} of the arm {_have(missing)} no {kind} limit; state it in "
                             f"{self.file.path.name}, for example limits: {{{kind}: 1.5}}, in rad/s or rad/s^2")
        for name in self.joints:
            value = values.get(name, default)
            if not _is_number(value) or value <= 0:
                raise self.error(f"limits: {kind} of joint '{name}' is {value!r}; expected a number above 0")
        return np.array([float(values.get(name, default)) for name in self.joints])

    def home(self, lower: Float[np.ndarray, " n"], upper: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """The home configuration, within the limits."""
        stated = self.file.home if self.file.home is not None else _home_key(self.arm.path)
        if stated is None:
            raise self.error("the file lacks the entry 'home', and the arm's file has no key of this name; state it, "
                             f"for example home: {{{', '.join(f'{name}: 0.0' for name in self.joints)}}}")
        home = self._by_joint("home", stated) if self.file.home is not None else stated
        if missing := [n for n in self.joints if n not in home]:
            raise self.error(f"home lacks {_joints(missing)}; the arm's joints are {', '.join(self.joints)}")
        q = np.array([home[n] for n in self.joints])
        if len(out := np.flatnonzero((q < lower) | (q > upper))):
            told = (f"home of joint '{self.joints[i]}' is {q[i]:g}, outside its limits {lower[i]:g} to {upper[i]:g}"
                    for i in out)
            raise self.error("; ".join(told))
        return q

    def _by_joint(self, what: str, values: Any) -> Mapping[str, Any]:
        if not isinstance(values, Mapping):
            raise self.error(f"{what} is {values!r}; expected values by joint")
        if unknown := [n for n in values if n not in self.joints]:
            raise self.error(f"{what} names joint '{unknown[0]}', which the arm does not have; its joints are "
                             f"{', '.join(self.joints)}")
        return values


def _joints(names: Sequence[str]) -> str:
    return f"{'joints' if names[1:] else 'joint'} {_quoted(names)}"


def _have(names: Sequence[str]) -> str:
    return "have" if names[1:] else "has"


def _home_key(path: Path) -> dict[str, float] | None:
    """The key `home` of an MJCF file by joint; None where there is none."""
    if parse_xml(path).tag == "robot":
        return None
    model = mujoco.MjModel.from_xml_path(str(path))
    if (key := mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, HOME_KEY)) < 0:
        return None
    single = {int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)}
    return {model.joint(i).name: float(model.key_qpos[key, model.jnt_qposadr[i]])
            for i in range(model.njnt) if int(model.jnt_type[i]) in single}


def _stated_limits(path: Path, kind: str) -> dict[str, float]:
    """What the arm's file states of its joints. Zero means that nothing is known.

    MuJoCo does not keep the velocities of a URDF, and MJCF has none; its efforts are those of joints and of their actuators.
    """
    if kind not in {"velocity", "effort"}:
        return {}
    root = parse_xml(path)
    if root.tag != "robot":
        return _mjcf_efforts(path) if kind == "effort" else {}
    found = {}
    for joint in root.findall("joint"):
        name, limit = joint.get("name", ""), joint.find("limit")
        stated = "0" if limit is None else limit.get(kind, "0")
        try:
            found[name] = float(stated)
        except ValueError:
            raise RobotError(f"{path}: joint '{name}' has {kind}=\"{stated}\"; expected a number") from None
    return {name: value for name, value in found.items() if value > 0}


def _mjcf_efforts(path: Path) -> dict[str, float]:
    model = mujoco.MjModel.from_xml_path(str(path))
    limited = [i for i in range(model.njnt) if model.jnt_actfrclimited[i]]
    found = {model.joint(i).name: float(model.jnt_actfrcrange[i].max()) for i in limited}
    for i in range(model.nu):
        if model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT and model.actuator_forcelimited[i]:
            found.setdefault(model.joint(model.actuator_trnid[i, 0]).name, float(model.actuator_forcerange[i].max()))
    return found
