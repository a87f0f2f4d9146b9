"""What a procedural hand is made of, and its URDF. All lengths in metres, all angles in radians."""

from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

Vector = tuple[float, float, float]
Side = Literal["left", "right", "none"]  # none for hands without a thumb, or whose thumb is on neither side
Thumb = Literal["opposed", "lateral", "none"]  # mounted before the palm, beside it, or nowhere
Family = Literal["row", "ring", "facing"]  # fingers in a row with a thumb, around a disc, or in two rows that face each other
PalmShape = Literal["box", "disc", "rounded", "two-part"]  # a disc is a cylinder; `rounded` has cylinders at its sides


@dataclass(frozen=True)
class Solid:
    """A box, a cylinder along its z axis, or a sphere."""

    size: tuple[float, ...]  # edges of a box along x, y, z; radius and length of a cylinder; radius of a sphere [m]
    position: Vector = (0.0, 0.0, 0.0)  # its middle in the link frame [m]
    rpy: Vector = (0.0, 0.0, 0.0)  # roll, pitch, yaw in the link frame [rad]

    @property
    def kind(self) -> str:
        """URDF's name of the shape."""
        return {3: "box", 2: "cylinder", 1: "sphere"}[len(self.size)]

    @property
    def volume(self) -> float:
        """Volume [m^3]."""
        if self.kind == "box":
            return float(np.prod(self.size))
        radius = self.size[0]
        return float(np.pi * radius**2 * self.size[1] if self.kind == "cylinder" else 4 / 3 * np.pi * radius**3)

    def inertia(self) -> Float[np.ndarray, "3 3"]:
        """Moments about its middle in the link's axes, for a mass of one [m^2]."""
        if self.kind == "box":
            squares = np.square(self.size)
            moments = (squares.sum() - squares) / 12
        elif self.kind == "cylinder":
            radius, length = self.size
            across = radius**2 / 4 + length**2 / 12
            moments = np.array([across, across, radius**2 / 2])
        else:
            moments = np.full(3, 0.4 * self.size[0] ** 2)
        turn = Rotation.from_euler("xyz", self.rpy).as_matrix()
        return turn @ np.diag(moments) @ turn.T

    def mirrored(self) -> Solid:
        """The solid seen in a mirror at the plane y = 0."""
        return dataclasses.replace(self, position=_mirrored_vector(self.position), rpy=_mirrored_turn(self.rpy))


@dataclass(frozen=True)
class Segment:
    """A link and the joint that carries it, at the link's origin."""

    position: Vector  # the joint in the frame of the link before it [m]
    axis: Vector  # unit vector in the link frame; positive angles close
    lower: float  # [rad]
    upper: float  # [rad]
    solids: tuple[Solid, ...]  # the link's shape
    rpy: Vector = (0.0, 0.0, 0.0)  # orientation of the link at angle zero, in the frame of the link before it [rad]
    open: float = 0.0  # angle in the open hand [rad]
    bends: bool = True
    """Whether it closes its finger from its lower limit on; false for joints that spread fingers or turn thumbs."""
    follows: float | None = None  # angle per angle of the joint before it (URDF mimic); None if it moves by itself

    def mirrored(self) -> Segment:
        """The segment seen in a mirror at the plane y = 0; the same angles give mirrored poses."""
        x, y, z = self.axis
        return dataclasses.replace(
            self, position=_mirrored_vector(self.position), rpy=_mirrored_turn(self.rpy), axis=(-x, y, -z),
            solids=tuple(solid.mirrored() for solid in self.solids))


@dataclass(frozen=True)
class FingerPlan:
    """A finger or thumb, from the palm outwards."""

    name: str  # prefix of its links and joints
    segments: tuple[Segment, ...]  # at least one


@dataclass(frozen=True)
class HandPlan:
    """A hand before it is written. Its root link is the palm."""

    family: Family  # arrangement of the fingers
    side: Side  # left or right, by design
    thumb: Thumb  # mount of the thumb, which is the last finger if there is one
    palm_shape: PalmShape  # shape of the palm
    palm_direction: Vector  # direction in which the palm faces, in the root link's frame
    palm: tuple[Solid, ...]  # the palm's shape
    fingers: tuple[FingerPlan, ...]  # fingers, then the thumb
    density: float  # mean density of all links [kg/m^3]
    folds_back: bool = False  # whether the limits let the fingers fold back behind the palm

    def open_posture(self) -> dict[str, float]:
        """Angles of the independent joints in the open hand, by name [rad]."""
        return {joint_name(finger, number): segment.open for finger in self.fingers
                for number, segment in enumerate(finger.segments) if segment.follows is None}

    def bending_joints(self) -> set[str]:
        """Names of the independent joints that close fingers."""
        return {joint_name(finger, number) for finger in self.fingers for number, segment in enumerate(finger.segments)
                if segment.bends and segment.follows is None}

    @property
    def joints(self) -> int:
        """Moving joints, followers included."""
        return sum(len(finger.segments) for finger in self.fingers)

    @property
    def followers(self) -> int:
        """Joints that follow others."""
        return sum(segment.follows is not None for finger in self.fingers for segment in finger.segments)

    def mirrored(self) -> HandPlan:
        """The other hand of the pair."""
        side: Side = {"left": "right", "right": "left", "none": "none"}[self.side]  # type: ignore[assignment]
        fingers = tuple(FingerPlan(f.name, tuple(s.mirrored() for s in f.segments)) for f in self.fingers)
        return dataclasses.replace(
            self, side=side, palm=tuple(solid.mirrored() for solid in self.palm), fingers=fingers,
            palm_direction=_mirrored_vector(self.palm_direction))


def joint_name(finger: FingerPlan, number: int) -> str:
    """Name of the joint that carries a finger's link, counted from the palm."""
    return f"{finger.name}_joint_{number}"


def _mirrored_vector(v: Vector) -> Vector:
    return v[0], -v[1], v[2]


def _mirrored_turn(rpy: Vector) -> Vector:
    roll, pitch, yaw = rpy
    return -roll, pitch, -yaw


def write_urdf(plan: HandPlan, name: str) -> str:
    """The URDF of a plan: the palm is the root link, visual and collision shapes are the same."""
    robot = ET.Element("robot", name=name)
    robot.append(ET.Comment(f" Procedural: {plan.family}, side {plan.side}, thumb {plan.thumb}, palm {plan.palm_shape}. "))
    _add_link(robot, "palm", plan.palm, plan.density)
    for finger in plan.fingers:
        parent, before = "palm", ""
        for number, segment in enumerate(finger.segments):
            link, joint = f"{finger.name}_{number}", joint_name(finger, number)
            _add_link(robot, link, segment.solids, plan.density)
            _add_joint(robot, joint, (parent, link), segment, before)
            parent, before = link, joint
    ET.indent(robot)
    return f'<?xml version="1.0"?>\n{ET.tostring(robot, encoding="unicode")}\n'


def _add_link(robot: ET.Element, name: str, solids: Sequence[Solid], density: float) -> None:
    link = ET.SubElement(robot, "link", name=name)
    _add_inertial(link, solids, density)
    for kind in ("visual", "collision"):
        for solid in solids:
            shape = ET.SubElement(link, kind)
            ET.SubElement(shape, "origin", xyz=_text(solid.position), rpy=_text(solid.rpy))
            geometry = ET.SubElement(shape, "geometry")
            if solid.kind == "box":
                ET.SubElement(geometry, "box", size=_text(solid.size))
            elif solid.kind == "cylinder":
                ET.SubElement(geometry, "cylinder", radius=_text(solid.size[:1]), length=_text(solid.size[1:]))
            else:
                ET.SubElement(geometry, "sphere", radius=_text(solid.size))


def _add_inertial(link: ET.Element, solids: Sequence[Solid], density: float) -> None:
    """Mass, centre and inertia of the solids together; where two overlap, the overlap counts twice."""
    masses = np.array([density * solid.volume for solid in solids])
    middles = np.array([solid.position for solid in solids])
    centre = masses @ middles / masses.sum()
    inertia = np.zeros((3, 3))
    for mass, solid, offset in zip(masses, solids, middles - centre, strict=True):
        inertia += mass * (solid.inertia() + offset @ offset * np.eye(3) - np.outer(offset, offset))
    element = ET.SubElement(link, "inertial")
    ET.SubElement(element, "origin", xyz=_text(centre))
    ET.SubElement(element, "mass", value=f"{masses.sum():.6g}")
    names = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
    ET.SubElement(element, "inertia", {key: f"{inertia[place]:.6g}" for key, place in names.items()})


def _add_joint(robot: ET.Element, name: str, links: tuple[str, str], segment: Segment, before: str) -> None:
    """The joint between two links (parent, child); a follower follows the joint named by `before`."""
    joint = ET.SubElement(robot, "joint", name=name, type="revolute")
    ET.SubElement(joint, "parent", link=links[0])
    ET.SubElement(joint, "child", link=links[1])
    ET.SubElement(joint, "origin", xyz=_text(segment.position), rpy=_text(segment.rpy))
    ET.SubElement(joint, "axis", xyz=_text(segment.axis))
    # Trials use the torque of their protocol, not this one [Nm].
    ET.SubElement(joint, "limit", lower=_text([segment.lower]), upper=_text([segment.upper]), effort="2", velocity="6")
    if segment.follows is not None:
        ET.SubElement(joint, "mimic", joint=before, multiplier=_text([segment.follows]))


def _text(values: Iterable[float]) -> str:
    return " ".join(f"{round(float(x), 6) + 0.0:g}" for x in values)
