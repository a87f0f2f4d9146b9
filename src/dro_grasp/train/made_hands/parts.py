"""Parts that plans are put together from: phalanges, fingers, palms."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from dro_grasp.train.made_hands.plan import Coupling, FingerPlan, FingerShape, PalmShape, Segment, Solid, Vector, rpy_of

Point = Float[np.ndarray, "3"]
SHARES = {1: (1.0,), 2: (0.56, 0.44), 3: (0.45, 0.30, 0.25)}
"""Shares of a finger's length, from the palm outwards, by its number of phalanges (ours; human fingers are close)."""
TAPER = 0.93  # Width of each phalanx as a share of the one before (ours)
STRAIGHT = -0.35  # Angle beyond which an open finger bends no farther backwards, although it may [rad] (ours)
KNUCKLE = 1.25  # Distance from a finger's first axis to its second one [half a finger's width] (ours)


@dataclass(frozen=True)
class Style:
    """What the fingers of one hand have in common."""

    radius: float  # half the thickness of a first phalanx [m]
    length: float  # length of the longest finger [m]
    phalanges: int  # phalanges of a finger, 2 or 3
    shape: FingerShape  # shape of the phalanges
    width: float  # width of a box-shaped phalanx as a share of its thickness
    coupling: Coupling  # joints that follow the one before
    ratios: tuple[float, float]  # angle of the second and of the third joint per angle of the one before, where they follow
    spread: float  # limit of the spreading joint to either side [rad]; 0 if there is none
    lower: float  # lower limit of the first bending joint [rad]
    uppers: tuple[float, float, float]  # upper limits of the bending joints [rad]


@dataclass(frozen=True)
class Mount:
    """Where a finger stands on the palm."""

    position: Point  # its first axis, in the palm's frame [m]
    along: Point  # direction of the straight finger
    closing: Point  # direction in which it closes; need not be perpendicular

    @property
    def frame(self) -> Float[np.ndarray, "3 3"]:
        """Axes as columns: x closing, z along the finger."""
        z = unit(self.along)
        x = unit(self.closing - (self.closing @ z) * z)
        return np.stack([x, np.cross(z, x), z], -1)


def unit(v: Point) -> Point:
    """The direction of a vector."""
    return v / np.linalg.norm(v)


def vector(v: Point) -> Vector:
    """An array as the tuple that plans hold."""
    x, y, z = v.tolist()
    return x, y, z


@dataclass(frozen=True)
class Turn:
    """A joint before a finger's bending joints: it spreads a finger or turns a thumb."""

    axis: Point  # unit vector in the palm's frame
    lower: float  # [rad]
    upper: float  # [rad]
    open: float = 0.0  # angle in the open hand [rad]


def finger_plan(name: str, mount: Mount, style: Style, length: float, turn: Turn | None = None) -> FingerPlan:
    """A finger of some length [m]: the turning joint if there is one, then the bending joints."""
    frame, radius = mount.frame, style.radius
    segments, position, rpy = [], vector(mount.position), rpy_of(frame)
    if turn is not None:
        axis = vector(frame.T @ turn.axis)
        segments.append(Segment(position, axis, turn.lower, turn.upper, _knuckle(style), rpy, turn.open, bends=False))
        position, rpy = (0.0, 0.0, KNUCKLE * radius), (0.0, 0.0, 0.0)
    before = 1.0
    for number, share in enumerate(SHARES[style.phalanges]):
        tip = number == style.phalanges - 1
        follows = number > 0 and (style.coupling == "all" or (style.coupling == "tip" and tip))
        ratio = style.ratios[number - 1] if follows else None
        lower, upper = (style.lower if number == 0 else 0.0), style.uppers[number]
        if ratio is not None:
            lower, upper = ratio * segments[-1].lower, ratio * segments[-1].upper
        solids = phalanx(style, radius * before, share * length, tip)
        segments.append(Segment(position, (0.0, 1.0, 0.0), lower, upper, solids, rpy, max(lower, STRAIGHT), follows=ratio))
        position, rpy, before = (0.0, 0.0, share * length), (0.0, 0.0, 0.0), before * TAPER
    return FingerPlan(name, tuple(segments))


def _knuckle(style: Style) -> tuple[Solid, ...]:
    """The short link between two crossing axes."""
    if style.shape == "capsule":
        return (Solid((style.radius,)),)
    return (Solid((style.radius, 2 * style.radius), rpy=(np.pi / 2, 0.0, 0.0)),)


def phalanx(style: Style, radius: float, length: float, tip: bool) -> tuple[Solid, ...]:
    """A link of half this thickness [m] and this length [m] from its joint to the next one, or to the round end of a tip."""
    straight = length - radius if tip else length
    middle, end = (0.0, 0.0, straight / 2), (0.0, 0.0, straight)
    if style.shape == "capsule":
        solids = Solid((radius,)), Solid((radius, straight), middle), Solid((radius,), end)
    else:
        wide, across = 2 * radius * style.width, (np.pi / 2, 0.0, 0.0)
        solids = (Solid((radius, wide), rpy=across), Solid((1.8 * radius, wide, straight), middle),
                  Solid((radius, wide), end, across))
    return solids if tip else solids[:2]


@dataclass(frozen=True)
class Block:
    """A palm that faces along its first axis: x is its depth, y its width, z its height, up to its upper end."""

    shape: PalmShape  # seen from above
    depth: float  # along the palm direction [m]
    width: float  # [m]
    height: float  # [m]

    def solids(self) -> tuple[Solid, ...]:
        """Its shape; the middle of the upper edge is at the origin."""
        d, w, h = self.depth, self.width, self.height
        if self.shape == "disc":
            return (Solid((h / 2, d), (0.0, 0.0, -h / 2), (0.0, np.pi / 2, 0.0)),)
        if self.shape == "rounded":
            edges = (Solid((d / 2, h), (0.0, y, -h / 2)) for y in (-(w - d) / 2, (w - d) / 2))
            return Solid((d, w - d, h), (0.0, 0.0, -h / 2)), *edges
        if self.shape == "two-part":
            low = 0.45 * h
            return (Solid((d, w, h - low), (0.0, 0.0, -(h - low) / 2)),
                    Solid((0.8 * d, 0.75 * w, low + 0.1 * h), (0.0, 0.0, -h + low / 2 + 0.05 * h)))
        return (Solid((d, w, h), (0.0, 0.0, -h / 2)),)

    def top(self, y: float) -> float:
        """Height of the upper edge at a place across the palm [m]."""
        if self.shape != "disc":
            return 0.0
        return float(np.sqrt(max((self.height / 2) ** 2 - y**2, 0.0)) - self.height / 2)

    def half_width(self, z: float) -> float:
        """Half the width at a height below the upper edge [m]."""
        if self.shape == "disc":
            return float(np.sqrt(max((self.height / 2) ** 2 - (z + self.height / 2) ** 2, 0.0)))
        return self.width * (0.375 if self.shape == "two-part" and z < -0.55 * self.height else 0.5)


def plate(shape: PalmShape, half: tuple[float, float], depth: float) -> tuple[Solid, ...]:
    """A palm of half these extents along x and y [m] that faces along z, with its upper face at z = 0."""
    x, y = half
    middle = (0.0, 0.0, -depth / 2)
    block = Solid((2 * x, 2 * y, depth), middle)
    if shape == "disc":
        return (Solid((max(half), depth), middle),)
    if shape == "rounded":
        return block, *(Solid((x, depth), (0.0, side, -depth / 2)) for side in (-y, y))
    if shape == "two-part":
        return block, Solid((0.7 * min(half), depth), (0.0, 0.0, -1.4 * depth))
    return (block,)


def lifted(
    solids: Sequence[Solid], fingers: Sequence[FingerPlan], height: float
) -> tuple[tuple[Solid, ...], tuple[FingerPlan, ...]]:
    """Palm and fingers with the root link's origin this far below [m]."""
    up = lambda p: (p[0], p[1], p[2] + height)  # noqa: E731
    raised = tuple(dataclasses.replace(solid, position=up(solid.position)) for solid in solids)
    moved = (dataclasses.replace(f.segments[0], position=up(f.segments[0].position)) for f in fingers)
    return raised, tuple(FingerPlan(f.name, (m, *f.segments[1:])) for f, m in zip(fingers, moved, strict=True))
