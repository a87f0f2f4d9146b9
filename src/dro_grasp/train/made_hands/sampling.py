"""Plans of hands drawn at random: a row of fingers with a thumb, fingers around a disc, or fingers that face each other."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float

from dro_grasp.train.made_hands.parts import Block, Mount, Style, Turn, finger_plan, lifted, plate, unit
from dro_grasp.train.made_hands.plan import Coupling, Family, FingerPlan, FingerShape, HandPlan, PalmShape, Thumb

Choice = TypeVar("Choice")


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


def sample_plan(generator: np.random.Generator, population: Population | None = None) -> HandPlan:
    """Draw a plan. It may be of a hand that cannot grasp."""
    dice = Dice(generator, population or Population())
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
