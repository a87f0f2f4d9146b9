"""The same hand in other words: URDF texts that describe one mechanism by other conventions.

What is read of a hand must not depend on them. `Words` says how values of the variant's joints relate to the original's:
`q = sign * theirs + zero`.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from dro_grasp.hands.hand import Hand
from dro_grasp.hands.variants import vary_hand

FREE = {"revolute", "continuous", "prismatic"}
TURN = Rotation.from_euler("xyz", (0.7, -0.4, 1.9))  # of a palm's frame, or of a flange


@dataclass
class Words:
    """A variant of a hand, and how to read its values."""

    root: ET.Element
    sign: dict[str, float] = field(default_factory=dict)
    zero: dict[str, float] = field(default_factory=dict)
    turned: Rotation = field(default_factory=Rotation.identity)  # from the variant's wrist frame to the original's

    @property
    def text(self) -> str:
        """The URDF."""
        return ET.tostring(self.root, encoding="unicode")

    def original(self, hand: Hand, q: Float[Tensor, "*b n_dof"], names: tuple[str, ...]) -> Float[Tensor, "*b n_dof"]:
        """Values of the original's joints, in the order of their names, of the variant's."""
        sign = torch.tensor([self.sign.get(name, 1.0) for name in names])
        zero = torch.tensor([self.zero.get(name, 0.0) for name in names])
        return sign * q[..., [hand.tree.joint_names.index(name) for name in names]] + zero


def words(name: str) -> Words:
    """A hand as its file describes it; its meshes are named by their absolute paths."""
    return Words(ET.fromstring(vary_hand(name)))


def _joints(root: ET.Element) -> list[ET.Element]:
    return [joint for joint in root.findall("joint") if joint.get("type") in FREE]


def _numbers(element: ET.Element | None, name: str, default: str) -> Float[np.ndarray, "3"]:
    return np.array([float(x) for x in (default if element is None else element.get(name, default)).split()])


def _pose(element: ET.Element) -> tuple[Rotation, Float[np.ndarray, "3"]]:
    origin = element.find("origin")
    return Rotation.from_euler("xyz", _numbers(origin, "rpy", "0 0 0")), _numbers(origin, "xyz", "0 0 0")


def _set_pose(element: ET.Element, turn: Rotation, shift: Float[np.ndarray, "3"]) -> None:
    origin = element.find("origin")
    origin = ET.SubElement(element, "origin") if origin is None else origin
    origin.set("rpy", " ".join(f"{x:.12g}" for x in turn.as_euler("xyz")))
    origin.set("xyz", " ".join(f"{x:.12g}" for x in shift))


def _axis(joint: ET.Element) -> Float[np.ndarray, "3"]:
    axis = _numbers(joint.find("axis"), "xyz", "1 0 0")
    return axis / np.linalg.norm(axis)


def reworded(its: Words, sign: Callable[[int], float], zero: Callable[[int], float]) -> Words:
    """Joints that count the other way, and from another zero [rad]; those that slide keep their zero."""
    joints = _joints(its.root)
    for i, joint in enumerate(joints):
        name, axis = joint.get("name", ""), _axis(joint)
        s, z = sign(i), 0.0 if joint.get("type") == "prismatic" else zero(i)
        turn, shift = _pose(joint)
        _set_pose(joint, turn * Rotation.from_rotvec(z * axis), shift)
        element = joint.find("axis")
        element = ET.SubElement(joint, "axis") if element is None else element
        element.set("xyz", " ".join(f"{s * x:.12g}" for x in axis))
        limit = joint.find("limit")
        if limit is not None and "lower" in limit.attrib:
            low, high = sorted((s * (float(limit.get("lower", 0)) - z), s * (float(limit.get("upper", 0)) - z)))
            limit.set("lower", f"{low:.12g}")
            limit.set("upper", f"{high:.12g}")
        its.sign[name], its.zero[name] = s, z
    for joint in joints:
        if (mimic := joint.find("mimic")) is not None:
            name, leader = joint.get("name", ""), mimic.get("joint", "")
            m, o = float(mimic.get("multiplier", 1)), float(mimic.get("offset", 0))
            mimic.set("multiplier", f"{its.sign[name] * m * its.sign[leader]:.12g}")
            mimic.set("offset", f"{its.sign[name] * (m * its.zero[leader] + o - its.zero[name]):.12g}")
    return its


def flipped(its: Words) -> Words:
    """Every other joint counts the other way."""
    return reworded(its, lambda i: -1.0 if i % 2 else 1.0, lambda i: 0.0)


def counted_from_elsewhere(its: Words) -> Words:
    """Every joint has another zero, by up to 0.9 rad, and every third counts the other way."""
    return reworded(its, lambda i: 1.0 if i % 3 else -1.0, lambda i: 0.9 * math.sin(1 + 2.0 * i))


def limited(its: Words, limits: Callable[[float, float], tuple[float, float]]) -> Words:
    """Joints that turn with other limits."""
    for joint in _joints(its.root):
        limit = joint.find("limit")
        if joint.get("type") != "prismatic" and limit is not None:
            low, high = limits(float(limit.get("lower", 0)), float(limit.get("upper", 0)))
            limit.set("lower", f"{low:.12g}")
            limit.set("upper", f"{high:.12g}")
    return its


def without_sense(its: Words) -> Words:
    """All limits that say nothing: 4 rad either way."""
    return limited(its, lambda low, high: (-4.0, 4.0))


def both_ways(its: Words) -> Words:
    """Joints that turn as far back as forth."""
    return limited(its, lambda low, high: (-max(-low, high), max(-low, high)))


def absurd(its: Words) -> Words:
    """Limits of a hundred radians."""
    return limited(its, lambda low, high: (-100.0, 100.0))


def _root_link(root: ET.Element) -> str:
    children = {joint.find("child").get("link") for joint in root.findall("joint")}  # type: ignore[union-attr]
    return next(name for link in root.findall("link") if (name := link.get("name", "")) not in children)


def _hung(its: Words, links: list[str], joints: list[str], turned: Rotation) -> Words:
    for text in (*links, *joints):
        its.root.append(ET.fromstring(text))
    its.turned = turned
    return its


def _joint(name: str, parent: str, child: str, kind: str, axis: str, turn: Rotation | None = None) -> str:
    rpy = " ".join(f"{x:.12g}" for x in (turn or Rotation.identity()).as_euler("xyz"))
    limits = "" if kind == "fixed" else '<limit lower="-1.5" upper="1.5" effort="9" velocity="1"/>'
    return (f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="0 0 0.04" rpy="{rpy}"/><axis xyz="{axis}"/>{limits}</joint>')


def on_a_wrist(its: Words) -> Words:
    """A forearm and a wrist of two joints in the file of the hand."""
    shape = '<geometry><cylinder radius="0.03" length="0.08"/></geometry>'
    forearm = (f'<link name="forearm"><visual><origin xyz="0 0 -0.06"/>{shape}</visual>'
               f'<collision><origin xyz="0 0 -0.06"/>{shape}</collision></link>')
    joints = [_joint("wrist_pitch", "forearm", "carpus", "revolute", "0 1 0"),
              _joint("wrist_yaw", "carpus", _root_link(its.root), "revolute", "1 0 0", TURN)]
    return _hung(its, [forearm, '<link name="carpus"/>'], joints, TURN.inv())


def with_a_turned_palm(its: Words) -> Words:
    """The frame of the root link turned in the hand."""
    root_link, back = _root_link(its.root), TURN.inv()
    for link in its.root.findall("link"):
        if link.get("name") == root_link:
            for part in (*link.findall("visual"), *link.findall("collision"), *link.findall("inertial")):
                turn, shift = _pose(part)
                _set_pose(part, back * turn, back.apply(shift))
    for joint in its.root.findall("joint"):
        if joint.find("parent").get("link") == root_link:  # type: ignore[union-attr]
            turn, shift = _pose(joint)
            _set_pose(joint, back * turn, back.apply(shift))
    its.turned = TURN
    return its


def split(its: Words) -> Words:
    """Every link that moves is two, and has a name that says nothing: a frame, and its shapes on a link fixed to it."""
    names = {link.get("name", ""): f"part_{i}" for i, link in enumerate(its.root.findall("link"))}
    moving = {joint.find("child").get("link") for joint in _joints(its.root)}  # type: ignore[union-attr]
    for joint in its.root.findall("joint"):
        for end in ("parent", "child"):
            element = joint.find(end)
            element.set("link", names[element.get("link", "")])  # type: ignore[union-attr]
    for link in its.root.findall("link"):
        name = link.get("name", "")
        link.set("name", names[name])
        if name in moving:
            shell = ET.SubElement(its.root, "link", name=f"{names[name]}_shell")
            for part in (*link.findall("visual"), *link.findall("collision")):
                link.remove(part)
                shell.append(part)
            its.root.append(ET.fromstring(_fixed(f"{names[name]}_weld", names[name], f"{names[name]}_shell")))
    return its


def _fixed(name: str, parent: str, child: str) -> str:
    return f'<joint name="{name}" type="fixed"><parent link="{parent}"/><child link="{child}"/></joint>'


WAYS = {"flipped": flipped, "other zero": counted_from_elsewhere, "wrist": on_a_wrist, "turned palm": with_a_turned_palm,
        "split": split, "4 rad": without_sense, "both ways": both_ways, "100 rad": absurd}
