"""Plans of hands drawn at random: a row of fingers with a thumb, fingers around a disc, or fingers that face each other.

They are put together from parts: phalanges, fingers, palms.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from dro_grasp.training.made_hands.plan import Family, FingerPlan, HandPlan, PalmShape, Segment, Solid, Thumb, Vector

FingerShape = Literal["capsule", "box"]  # a cylinder with spheres at its ends, or a box with cylinders across its ends
Coupling = Literal["free", "tip", "all"]  # joints that follow the one before: none, the last one, or all but the first
Choice = TypeVar("Choice")
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


def rpy_of(rotation: Float[np.ndarray, "3 3"]) -> Vector:
    """Roll, pitch and yaw of a rotation [rad]."""
    roll, pitch, yaw = Rotation.from_matrix(rotation).as_euler("xyz").tolist()
    return roll, pitch, yaw


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


class Population(NamedTuple):
    """What hands are drawn: shares of kinds, and ranges (all ours)."""

    families: Mapping[Family, float] = {"row": 0.74, "ring": 0.12, "facing": 0.14}
    in_row: Mapping[int, float] = {1: 0.06, 2: 0.18, 3: 0.32, 4: 0.44}  # fingers beside the thumb
    in_ring: Mapping[int, float] = {2: 0.15, 3: 0.40, 4: 0.25, 5: 0.20}  # fingers
    facing: Mapping[tuple[int, int], float] = {(1, 1): 0.15, (2, 1): 0.35, (2, 2): 0.2, (3, 1): 0.15, (3, 2): 0.15}
    """Fingers on either side."""
    row_palms: Mapping[PalmShape, float] = {"box": 0.4, "disc": 0.15, "rounded": 0.3, "two-part": 0.15}
    ring_palms: Mapping[PalmShape, float] = {"disc": 0.75, "two-part": 0.25}
    facing_palms: Mapping[PalmShape, float] = {"box": 0.4, "rounded": 0.3, "two-part": 0.3}
    thumbs: Mapping[Thumb, float] = {"lateral": 0.7, "opposed": 0.3}  # in the family `row`
    finger_shapes: Mapping[FingerShape, float] = {"capsule": 0.6, "box": 0.4}
    couplings: Mapping[Coupling, float] = {"free": 0.5, "tip": 0.25, "all": 0.25}
    lengths: tuple[float, float] = (0.055, 0.12)  # of the longest finger [m]; a human middle finger has about 0.08
    thickness: tuple[float, float] = (0.085, 0.125)  # half a finger's, as a share of its length; a human finger has about 0.1
    densities: tuple[float, float] = (400.0, 1100.0)  # mean [kg/m^3]; LEAP's links have about 450, solid plastic 1100
    folding_back: float = 0.2  # share of hands with free joints whose fingers can fold back behind the palm


@dataclass(frozen=True)
class Dice:
    """Draws of one stream, from one population."""

    generator: np.random.Generator
    population: Population

    def among(self, shares: Mapping[Choice, float]) -> Choice:
        """One of the keys, with the probabilities that they have."""
        chances = np.array(list(shares.values()))
        return list(shares)[int(self.generator.choice(len(chances), p=chances / chances.sum()))]

    def between(self, low: float, high: float) -> float:
        """Uniform in a range."""
        return float(self.generator.uniform(low, high))

    def chance(self, probability: float) -> bool:
        """True with this probability."""
        return bool(self.generator.random() < probability)


def sample_plan(generator: np.random.Generator) -> HandPlan:
    """Draw a plan. It may be of a hand that cannot grasp."""
    dice = Dice(generator, Population())
    family = dice.among(dice.population.families)
    style, folds_back = _style(dice)
    draw = {"row": _row, "ring": _ring, "facing": _facing}[family]
    plan = draw(dice, style, folds_back)
    return plan.mirrored() if dice.chance(0.5) else plan


def _style(dice: Dice) -> tuple[Style, bool]:
    """What the fingers have in common, and whether they can fold back."""
    length = float(np.exp(dice.between(*np.log(dice.population.lengths))))
    coupling = dice.among(dice.population.couplings)
    folds_back = coupling != "all" and dice.chance(dice.population.folding_back)
    lower = 0.0 if coupling == "all" else -dice.between(0.0, 0.35)
    style = Style(
        radius=length * dice.between(*dice.population.thickness), length=length, phalanges=dice.among({2: 0.4, 3: 0.6}),
        shape=dice.among(dice.population.finger_shapes), width=dice.between(0.8, 1.2), coupling=coupling,
        ratios=(dice.between(0.8, 1.2), dice.between(0.5, 1.0)),
        spread=dice.between(0.2, 0.5) if dice.chance(0.5) else 0.0,
        lower=-dice.between(0.9, 1.6) if folds_back else lower,
        uppers=(dice.between(1.2, 1.6), dice.between(1.2, 1.8), dice.between(0.9, 1.4)),
    )
    return style, folds_back


def _row(dice: Dice, style: Style, folds_back: bool) -> HandPlan:
    """A right hand: fingers up along z, palm towards x, thumb towards y."""
    count = dice.among(dice.population.in_row)
    pitch = 2 * style.radius * (max(style.width, 1.0) if style.shape == "box" else 1.0) * dice.between(1.15, 1.6)
    block = _block(dice, style, max(count * pitch, 3 * style.radius))
    fan, lean = dice.between(0.0, 0.12), dice.between(-0.1, 0.2)
    fingers = []
    for i in range(count):
        place = i - (count - 1) / 2
        along = np.array([np.sin(lean), np.sin(fan * place), np.cos(lean)])
        position = np.array([0.15 * block.depth, place * pitch, block.top(place * pitch)])
        mount = Mount(position, along, np.array([1.0, 0.0, 0.0]))
        turn = Turn(mount.frame[:, 0], -style.spread, style.spread) if style.spread and count > 1 else None
        length = style.length * (1 - 0.06 * abs(place + 0.3)) * dice.between(0.92, 1.0)
        fingers.append(finger_plan(f"finger{i}", mount, style, length, turn))
    thumb = dice.among(dice.population.thumbs)
    fingers.append(_lateral_thumb(dice, style, block) if thumb == "lateral" else _opposed_thumb(dice, style, block))
    palm, raised = lifted(block.solids(), fingers, dice.among({0.0: 1, 0.5: 1, 1.0: 1}) * block.height)
    return HandPlan("row", "right" if thumb == "lateral" else "none", thumb, block.shape, (1.0, 0.0, 0.0), palm, raised,
                    dice.between(*dice.population.densities), folds_back)


def _block(dice: Dice, style: Style, width: float) -> Block:
    shape = dice.among(dice.population.row_palms)
    depth, height = style.radius * dice.between(2.0, 3.2), style.length * dice.between(0.75, 1.1)
    if shape == "disc":
        height = max(height, 1.15 * width)
        width = height
    if shape == "rounded":
        width = max(width, 1.3 * depth)
    return Block(shape, depth, width, height)


def _meeting_point(style: Style, block: Block) -> Float[np.ndarray, "3"]:
    """Where the half-closed fingers and the thumb meet, in front of the palm [m]."""
    return np.array([block.depth / 2 + 0.5 * style.length, 0.0, 0.15 * style.length])


def _thumb_style(dice: Dice, style: Style) -> Style:
    """The thumb's: thicker, often with fewer phalanges, never folding back."""
    lower = 0.0 if style.coupling == "all" else -dice.between(0.0, 0.4)
    return dataclasses.replace(style, radius=style.radius * dice.between(1.0, 1.2), lower=lower,
                               phalanges=min(style.phalanges, dice.among({2: 0.6, 3: 0.4})))


def _lateral_thumb(dice: Dice, style: Style, block: Block) -> FingerPlan:
    """A thumb beside the palm that closes across it; often it also turns about the palm's long axis."""
    own = _thumb_style(dice, style)
    z = -dice.between(0.4, 0.8) * block.height
    position = np.array([dice.between(0.0, 0.5) * block.depth, block.half_width(z) + 0.4 * own.radius, z])
    offset = _meeting_point(style, block) - position
    opened = dice.between(0.5, 1.0)
    along = np.cos(opened) * unit(offset) + np.sin(opened) * np.array([0.0, 1.0, 0.0])
    turn = None
    if dice.chance(0.65):
        lower = -dice.between(0.4, 1.0)
        turn = Turn(np.array([0.0, 0.0, -1.0]), lower, dice.between(0.2, 0.7), lower)
    length = float(np.clip(np.linalg.norm(offset) * dice.between(0.95, 1.25), 0.7 * style.length, 1.25 * style.length))
    return finger_plan("thumb", Mount(position, along, offset), own, length, turn)


def _opposed_thumb(dice: Dice, style: Style, block: Block) -> FingerPlan:
    """A thumb before the palm that closes towards the fingers."""
    own = _thumb_style(dice, style)
    z = -dice.between(0.5, 0.9) * block.height
    position = np.array([block.depth / 2, dice.between(-0.2, 0.35) * block.half_width(z), z])
    offset = _meeting_point(style, block) - position
    opened = dice.between(0.3, 0.8)
    along = np.cos(opened) * unit(offset) + np.sin(opened) * unit(np.array([0.4, 0.0, -1.0]))
    mount = Mount(position, along, offset)
    turn = Turn(mount.frame[:, 0], -dice.between(0.2, 0.6), dice.between(0.2, 0.6)) if dice.chance(0.5) else None
    length = float(np.clip(np.linalg.norm(offset) * dice.between(0.95, 1.25), 0.7 * style.length, 1.25 * style.length))
    return finger_plan("thumb", mount, own, length, turn)


def _ring(dice: Dice, style: Style, folds_back: bool) -> HandPlan:
    """Fingers around a palm that faces along z."""
    count = dice.among(dice.population.in_ring)
    radius = max(style.length * dice.between(0.3, 0.6), 1.5 * style.radius * count / np.pi + style.radius)
    tilt, start = dice.between(0.0, 0.5), dice.between(0.0, 2 * np.pi)
    fingers = []
    for i in range(count):
        angle = start + 2 * np.pi * (i + dice.between(-0.06, 0.06)) / count
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        mount = Mount(radius * out, np.sin(tilt) * out + np.cos(tilt) * np.array([0.0, 0.0, 1.0]), -out)
        turn = Turn(mount.frame[:, 2], -style.spread, style.spread) if style.spread else None
        fingers.append(finger_plan(f"finger{i}", mount, style, style.length * dice.between(0.95, 1.0), turn))
    shape = dice.among(dice.population.ring_palms)
    depth = style.radius * dice.between(2.0, 4.0)
    solids = plate("disc", (radius + style.radius, radius + style.radius), depth)
    if shape == "two-part":
        solids = (*solids, *plate("disc", (0.6 * radius, 0.6 * radius), 2 * depth))
    palm, raised = lifted(solids, fingers, depth * dice.among({0: 1, 1: 1}))
    density = dice.between(*dice.population.densities)
    return HandPlan("ring", "none", "none", shape, (0.0, 0.0, 1.0), palm, raised, density, folds_back)


def _facing(dice: Dice, style: Style, folds_back: bool) -> HandPlan:
    """Two rows of fingers that close towards each other, on a palm that faces along z."""
    sides = dice.among(dice.population.facing)
    half = style.length * dice.between(0.25, 0.5)
    pitch = 2 * style.radius * max(style.width, 1.0) * dice.between(1.3, 2.4)
    tilt = dice.between(-0.05, 0.45)
    fingers = []
    for sign, count in zip((1.0, -1.0), sides, strict=True):
        for i in range(count):
            out = np.array([sign, 0.0, 0.0])
            position = half * out + np.array([0.0, (i - (count - 1) / 2) * pitch, 0.0])
            mount = Mount(position, np.sin(tilt) * out + np.cos(tilt) * np.array([0.0, 0.0, 1.0]), -out)
            turn = Turn(mount.frame[:, 0], -style.spread, style.spread) if style.spread and count > 1 else None
            alone = sign < 0 and sides[1] == 1 and sides[0] > 1
            name = "thumb" if alone else f"finger{len(fingers)}"
            fingers.append(finger_plan(name, mount, style, style.length * dice.between(0.92, 1.0), turn))
    shape = dice.among(dice.population.facing_palms)
    depth = style.radius * dice.between(2.0, 4.0)
    solids = plate(shape, (half + style.radius, max(sides) * pitch / 2), depth)
    palm, raised = lifted(solids, fingers, depth * dice.among({0: 1, 1: 1}))
    thumb: Thumb = "opposed" if sides[1] == 1 and sides[0] > 1 else "none"
    density = dice.between(*dice.population.densities)
    return HandPlan("facing", "none", thumb, shape, (0.0, 0.0, 1.0), palm, raised, density, folds_back)
