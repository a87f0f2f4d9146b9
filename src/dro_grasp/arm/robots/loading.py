"""Robots from robot files: each is compared with its arm and hand, and all that is wrong is said at once."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from jaxtyping import Float

from dro_grasp.arm.robots.drivers import ANGLES, LENGTHS, Drivers
from dro_grasp.arm.robots.robot import Robot
from dro_grasp.arm.robots.robot_file import RobotFile, quoted
from dro_grasp.errors import HandError, RobotError
from dro_grasp.files import given_path
from dro_grasp.hands.description.compiling import MAX_TURN, mujoco_speaks_to
from dro_grasp.hands.description.loader import Description, load_description, named
from dro_grasp.hands.description.reduction import NO_LIMITS
from dro_grasp.hands.description.xml_files import parse_xml
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand, locate_hand
from dro_grasp.kinds import is_number

BUILTIN_ROBOTS = Path(__file__).parent / "builtin"  # Folder of the built-in robots
FARTHEST_ZERO = 10.0  # Largest stated zero of a driver of a joint that slides [m] (ours); of one that turns it is a turn
HAND_LIMITS = {"velocity": 2.0, "acceleration": 10.0}
"""Usual limits of a hand's joints [rad/s, rad/s^2], for slides times SLIDING_UNIT (ours)."""
HOME_KEY = "home"  # Name that MJCF files give the key in which a robot waits, as those of MuJoCo Menagerie do


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
    path = locate_robot(name)
    file = RobotFile(path)
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
        fast, quick = (faults.of(lambda kind=kind: _hand_limit(file, hand.path, loaded, kind), np.zeros(loaded.tree.n_dof))
                       for kind in HAND_LIMITS)
    source = path.stem if path.parent == BUILTIN_ROBOTS else str(path.resolve())
    return Robot(
        file.name, arm, loaded, fit.mount, file.T_link_wrist, file.T_world_base, home, lower, upper, velocity, acceleration,
        effort, fast, quick, file.camera, file.table, drivers, source)


def _hand_limit(file: RobotFile, path: Path, hand: Hand, kind: str) -> Float[np.ndarray, " n_dof"]:
    """A limit of the hand's joints: one for all, or by joint; else what its URDF states, up to what is usual."""
    given, names = file.hand_limits.get(kind, {}), hand.tree.joint_names
    if not isinstance(given, dict):
        return np.full(len(names), file.positive(given, f"hand_limits: {kind}"))
    if unknown := [str(name) for name in given if name not in names]:
        raise file.error(f"hand_limits: {kind} names joint '{unknown[0]}'; the joints of the hand are {', '.join(names)}")
    usual = HAND_LIMITS[kind] * hand.tree.joint_unit.double().numpy()
    stated = _stated_limits(path, kind)
    return np.array([file.positive(given[name], f"hand_limits: {kind} of joint {name}") if name in given
                     else min(most, stated.get(name, most)) for name, most in zip(names, usual.tolist(), strict=True)])


def _load_arm(file: RobotFile, within: str | None) -> Description:
    try:
        return load_description(file.arm, within, arm=True)
    except HandError as error:
        path = str(file.arm)
        reason = path.join(re.sub(r"\bhand\b", "robot", part) for part in str(error).split(path))
        raise file.error(f"the arm cannot be used: {reason}") from error


def _drivers(file: RobotFile, arm: Description, hand: Hand) -> Drivers:
    """What the file states of drivers, by the joints of arm and hand; one that both have is told apart as `hand/NAME`."""
    turns = [unit == 1 for tree in (arm.tree, hand.tree) for unit in tree.joint_unit.tolist()]
    names = [*arm.tree.joint_names, *hand.tree.joint_names]
    shared = set(arm.tree.joint_names) & set(hand.tree.joint_names)
    called = [f"{'arm' if i < arm.tree.n_dof else 'hand'}/{name}" if name in shared else name for i, name in enumerate(names)]
    for key, stated in file.drivers.items():
        if unknown := [str(name) for name in stated if name not in called]:
            raise file.error(f"{key} names joint '{unknown[0]}'; the joints of arm and hand are {', '.join(called)}")
    zeros = [_zero(file, name, turn) for name, turn in zip(called, turns, strict=True)]
    scales = [_sign(file, name) * _unit(file, name, ANGLES if turn else LENGTHS)
              for name, turn in zip(called, turns, strict=True)]
    return Drivers(tuple(zeros), tuple(scales))


def _zero(file: RobotFile, name: str, turns: bool) -> float:
    zero = file.number(file.drivers["zeros"].get(name, 0.0), f"zeros of joint {name}")
    if abs(zero) > (farthest := 2 * math.pi if turns else FARTHEST_ZERO):
        unit, other = ("rad", "degrees") if turns else ("m", "millimetres")
        raise file.error(f"zeros of joint {name} is {zero:g}, as if it were in {other}; expected -{farthest:.4g} to "
                         f"{farthest:.4g} {unit}, as the description counts")
    return zero


def _sign(file: RobotFile, name: str) -> float:
    sign = file.drivers["signs"].get(name, 1)
    if sign not in (1, -1) or isinstance(sign, bool):
        raise file.error(f"signs of joint {name} is {sign!r}; expected 1, or -1 where its driver counts the other way")
    return float(sign)


def _unit(file: RobotFile, name: str, known: dict[str, float]) -> float:
    unit = file.drivers["units"].get(name, 1.0)
    if isinstance(unit, str) and unit in known:
        return known[unit]
    if isinstance(unit, str):
        whole = "metre" if known is LENGTHS else "radian"
        raise file.error(f"units of joint {name} is '{unit}'; expected {', '.join(known)}, or how many of them a {whole} has")
    return file.positive(unit, f"units of joint {name}")


class _Fit:
    """Compares a robot file with its arm."""

    def __init__(self, file: RobotFile, arm: Description, mount: str) -> None:
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
                if not isinstance(ends, list) or len(ends) != 2 or not all(map(is_number, ends)) or not ends[0] < ends[1]:
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
            if not is_number(value) or value <= 0:
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
    return f"{'joints' if names[1:] else 'joint'} {quoted(names)}"


def _have(names: Sequence[str]) -> str:
    return "have" if names[1:] else "has"


def _home_key(path: Path) -> dict[str, float] | None:
    """The key `home` of an MJCF file by joint; None where there is none."""
    if parse_xml(path).tag == "robot":
        return None
    model = _bare(path)
    if (key := mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, HOME_KEY)) < 0:
        return None
    single = {int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)}
    return {model.joint(i).name: float(model.key_qpos[key, model.jnt_qposadr[i]])
            for i in range(model.njnt) if int(model.jnt_type[i]) in single}


def _bare(path: Path) -> mujoco.MjModel:
    """Joints, actuators and keys of an MJCF file: compiled without meshes, textures and masses, which may need repair."""
    try:
        with mujoco_speaks_to([], path):
            spec = mujoco.MjSpec.from_file(str(path))
            for geom in spec.geoms:
                if geom.meshname or geom.hfieldname:
                    geom.meshname = geom.hfieldname = ""
                    geom.type, geom.size = mujoco.mjtGeom.mjGEOM_SPHERE, [0.01, 0.0, 0.0]
            for body in list(spec.bodies)[1:]:
                body.explicitinertial, body.mass, body.inertia, body.fullinertia = True, 1.0, np.ones(3), np.full(6, np.nan)
            for material in spec.materials:
                material.textures = [""] * len(material.textures)
            for item in [*spec.meshes, *spec.hfields, *spec.skins, *spec.textures]:
                spec.delete(item)
            return spec.compile()
    except HandError as error:
        raise RobotError(f"keys and actuators of the arm cannot be read: {error}; correct the file") from error


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
    model = _bare(path)
    limited = [i for i in range(model.njnt) if model.jnt_actfrclimited[i]]
    found = {model.joint(i).name: float(model.jnt_actfrcrange[i].max()) for i in limited}
    for i in range(model.nu):
        if model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT and model.actuator_forcelimited[i]:
            found.setdefault(model.joint(model.actuator_trnid[i, 0]).name, float(model.actuator_forcerange[i].max()))
    return found
