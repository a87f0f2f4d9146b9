"""What a procedural hand is made of: solids, segments, fingers. All lengths in metres, all angles in radians."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

Vector = tuple[float, float, float]
"""Three coordinates, in the frame that the field names."""
Side = Literal["left", "right", "none"]
"""Handedness; none for hands without a thumb, or whose thumb is on neither side."""
Thumb = Literal["opposed", "lateral", "none"]
"""Where the thumb is mounted: before the palm, beside it, or nowhere."""
Family = Literal["row", "ring", "facing"]
"""Fingers in a row with a thumb, around a disc, or in two rows that face each other."""
PalmShape = Literal["box", "disc", "rounded", "two-part"]
"""Shape of the palm: a cylinder if it is a disc; `rounded` is a box with cylinders at its sides."""
FingerShape = Literal["capsule", "box"]
"""Shape of the phalanges: a cylinder with spheres at its ends, or a box with cylinders across its ends."""
Coupling = Literal["free", "tip", "all"]
"""Joints of a finger that follow the one before: none, the last one, or all but the first."""


def rotation_of(rpy: Vector) -> Float[np.ndarray, "3 3"]:
    """The rotation of URDF's roll, pitch and yaw."""
    return Rotation.from_euler("xyz", rpy).as_matrix()


def rpy_of(rotation: Float[np.ndarray, "3 3"]) -> Vector:
    """Roll, pitch and yaw of a rotation [rad]."""
    roll, pitch, yaw = Rotation.from_matrix(rotation).as_euler("xyz").tolist()
    return roll, pitch, yaw


@dataclass(frozen=True)
class Solid:
    """A box, a cylinder along its z axis, or a sphere."""

    size: tuple[float, ...]
    """Edges of a box along x, y, z; radius and length of a cylinder; radius of a sphere [m]."""
    position: Vector = (0.0, 0.0, 0.0)
    """Its middle in the link frame [m]."""
    rpy: Vector = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw in the link frame [rad]."""

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
        turn = rotation_of(self.rpy)
        return turn @ np.diag(moments) @ turn.T

    def mirrored(self) -> Solid:
        """The solid seen in a mirror at the plane y = 0."""
        return dataclasses.replace(self, position=_mirrored_vector(self.position), rpy=_mirrored_turn(self.rpy))


@dataclass(frozen=True)
class Segment:
    """A link and the joint that carries it, at the link's origin."""

    position: Vector
    """The joint in the frame of the link before it [m]."""
    axis: Vector
    """Unit vector in the link frame; positive angles close."""
    lower: float
    """Lower limit [rad]."""
    upper: float
    """Upper limit [rad]."""
    solids: tuple[Solid, ...]
    """The link's shape."""
    rpy: Vector = (0.0, 0.0, 0.0)
    """Orientation of the link at angle zero, in the frame of the link before it [rad]."""
    open: float = 0.0
    """Angle in the open hand [rad]."""
    bends: bool = True
    """Whether it closes its finger from its lower limit on; false for joints that spread fingers or turn thumbs."""
    follows: float | None = None
    """Angle per angle of the joint before it (URDF mimic); None if it moves by itself."""

    def mirrored(self) -> Segment:
        """The segment seen in a mirror at the plane y = 0; the same angles give mirrored poses."""
        x, y, z = self.axis
        return dataclasses.replace(
            self, position=_mirrored_vector(self.position), rpy=_mirrored_turn(self.rpy), axis=(-x, y, -z),
            solids=tuple(solid.mirrored() for solid in self.solids))


@dataclass(frozen=True)
class FingerPlan:
    """A finger or thumb, from the palm outwards."""

    name: str
    """Prefix of its links and joints."""
    segments: tuple[Segment, ...]
    """At least one."""


@dataclass(frozen=True)
class HandPlan:
    """A hand before it is written. Its root link is the palm."""

    family: Family
    """Arrangement of the fingers."""
    side: Side
    """Left or right, by design."""
    thumb: Thumb
    """Mount of the thumb, which is the last finger if there is one."""
    palm_shape: PalmShape
    """Shape of the palm."""
    palm_direction: Vector
    """Direction in which the palm faces, in the root link's frame."""
    palm: tuple[Solid, ...]
    """The palm's shape."""
    fingers: tuple[FingerPlan, ...]
    """Fingers, then the thumb."""
    density: float
    """Mean density of all links [kg/m^3]."""
    folds_back: bool = False
    """Whether the limits let the fingers fold back behind the palm."""

    def open_posture(self) -> dict[str, float]:
        """Angles of the independent joints in the open hand, by joint name [rad]."""
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


def link_name(finger: FingerPlan, number: int) -> str:
    """Name of a finger's link, counted from the palm."""
    return f"{finger.name}_{number}"


def joint_name(finger: FingerPlan, number: int) -> str:
    """Name of the joint that carries this link."""
    return f"{finger.name}_joint_{number}"


def _mirrored_vector(v: Vector) -> Vector:
    return v[0], -v[1], v[2]


def _mirrored_turn(rpy: Vector) -> Vector:
    roll, pitch, yaw = rpy
    return -roll, pitch, -yaw
