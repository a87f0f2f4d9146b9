"""Starts of synthesis: palms that face the object from wanted sides, fingers half open, nothing in penetration."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.devices import Rows
from dro_grasp.geometry.distance_field import Ball, Balls, DistanceField, DistanceFields
from dro_grasp.geometry.se3 import apply_to_cloud, compose, random_rotations, roma, rotate, rotation_between
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import Checked
from dro_grasp.optimize.grasp_energy import EnergyConfig, Surroundings

Direction = tuple[float, float, float]  # A vector in the object's frame, of any length but zero
CLEAR = EnergyConfig.clear  # Distance from its surroundings at which a hand starts [m]: the one that it keeps later
LARGEST_TILT = math.radians(60.0)
"""How far palms tilt from the wanted direction towards a plane, where the hand needs room [rad] (ours)."""
TILT_COST = 0.03  # Depth in the surroundings that a tilt of one radian is worth [m/rad] (ours)
APPROACH = 0.10  # Length of the straight approach along the palm direction, which a hand has room for [m] (ours)
ROOM_POINTS = 96  # Hand points, spread evenly, at which room is measured (ours)


def approach_cost(
    hand: Hand, T: Float[Tensor, "*b 4 4"], points: Float[Tensor, "*n p 3"], direction: Direction | None,
    surroundings: Surroundings,
) -> Float[Tensor, "*b"]:
    """How deep hands get into their surroundings on a straight approach [m], and for how much of a tilt from the direction.

    Points are the hand's surface points in the wrist frame [m]. Tilts from a palm direction that was wanted cost something.
    """
    placed = apply_to_cloud(T, points[..., hand.spread_rank < ROOM_POINTS, :])
    back = -APPROACH * hand.palm_directions(T)[..., None, :]
    nearest = [surroundings.distances(placed + share * back)[0].amin(-1) for share in (0.0, 0.5, 1.0)]
    lack = (CLEAR - torch.stack(nearest).amin(0)).clamp_min(0)
    if direction is None:
        return lack
    wanted = torch.nn.functional.normalize(torch.tensor(direction).to(T), dim=0)
    return lack + TILT_COST * torch.acos((hand.palm_directions(T) @ wanted).clamp(-1, 1))


def angle_to_arc(
    palm: Float[Tensor, "n 3"], wanted: Float[Tensor, "3"], up: Float[Tensor, "3"] | None
) -> Float[Tensor, " n"]:
    """Angles between palm directions and the nearest that is allowed [rad]: the wanted one, or tilted from there to a plane."""
    nearest = wanted.expand_as(palm)
    if up is not None:
        axis, most = _tilt(wanted, up)
        beside = torch.linalg.cross(axis, wanted)
        tilt = torch.atan2(palm @ beside, palm @ wanted).clamp_min(0).clamp_max(most)[:, None]
        nearest = tilt.cos() * wanted + tilt.sin() * beside
    return torch.atan2(torch.linalg.cross(palm, nearest).norm(dim=-1), (palm * nearest).sum(-1))


def _tilt(wanted: Float[Tensor, "3"], up: Float[Tensor, "3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, ""]]:
    """The axis about which a palm direction tilts towards a plane, and the largest angle [rad]."""
    across = torch.linalg.cross(wanted, -up)
    most = torch.atan2(across.norm(), -wanted @ up).clamp_max(LARGEST_TILT)
    return torch.nn.functional.normalize(across, dim=0), most


class Spread(NamedTuple):
    """How palm directions are spread around the wanted one."""

    deviation: float  # standard deviation [rad]
    max_tilt: float | None = None  # evenly within this angle instead [rad]


def wrist_rotations(
    hand: Hand, count: int, direction: Direction | None, spread: Spread, generator: torch.Generator,
    up: Float[Tensor, "3"] | None = None,
) -> Float[Tensor, "count 3 3"]:
    """Random wrist rotations: uniform, or with the palm near a direction in the object's frame and any roll.

    `up` is the normal of a plane towards which palms also tilt, by up to LARGEST_TILT; not where `spread` has a `max_tilt`.
    """
    palm = hand.palm_direction_wrist
    if direction is None:
        return random_rotations(count, generator).to(palm)
    wanted = torch.tensor(direction, dtype=torch.float32)
    wanted = wanted / wanted.norm()
    roll = torch.rand(count, generator=generator) * 2 * math.pi
    tilt = torch.randn(count, 3, generator=generator) * spread.deviation
    tilt = tilt - (tilt @ wanted)[:, None] * wanted
    align = rotation_between(palm.cpu(), wanted)
    if spread.max_tilt is not None:
        height = 1 - torch.rand(count, 1, generator=generator) * (1 - math.cos(spread.max_tilt))
        tilt = torch.nn.functional.normalize(tilt, dim=-1) * torch.acos(height)
    elif up is not None:
        axis, most = _tilt(wanted, up.cpu())
        tilt = tilt + torch.rand(count, 1, generator=generator) * most * axis
    return (roma.rotvec_to_rotmat(tilt) @ roma.rotvec_to_rotmat(roll[:, None] * wanted) @ align).to(palm)


CHOICES = 8  # Wrist rotations among which each hand takes the one with most room (ours)


@dataclass(frozen=True)
class StartConfig(Checked):
    """Distribution of the starts. Source of the scheme: DexGraspNet; the numbers are ours."""

    openness: tuple[float, float] = (0.0, 1.0)  # range of the share of the way from closed to open, one draw a grasp
    joint_noise: float = 0.6
    """Standard deviation of each joint, as a share of its range; many joints start at a limit. (0.08 halves the diversity of
    the joints and yields no more.)"""
    aim: float = 0.6  # largest share of the way from the object's centre to a random surface point at which the palm aims
    direction: Direction | None = None  # palm direction in the object's frame; any by default
    direction_spread: float = math.radians(5.0)  # standard deviation of the palm direction around the given one [rad]
    max_tilt: float | None = None  # palm directions are spread evenly within this angle of the given one instead [rad]
    contact_region: tuple[Ball, ...] = ()  # places at which palms aim, where there are any; at all of the object by default
    gap: tuple[float, float] = (0.0, 0.01)  # range of the distance between hand and object [m]
    clearance: float = 0.6  # how far outside the object's bounding sphere the approach begins [radius of the hand]
    approach_steps: int = 24  # steps of the approach along the palm direction


def start_joints(hand: Hand, n: int, config: StartConfig, generator: torch.Generator) -> Float[Tensor, "n n_dof"]:
    """Partly closed hands with some noise on every joint, no farther open than the hand opens [rad or m]."""
    low, high = config.openness
    share = low + (high - low) * torch.rand(n, 1, generator=generator)
    opened, closed = hand.canonical_joints(1.0), hand.canonical_joints(0.0)
    q = opened * share + closed * (1 - share)
    span = hand.upper - hand.lower
    q = q + config.joint_noise * span * torch.randn(n, hand.tree.n_dof, generator=generator)
    q = q.clamp(hand.lower, hand.upper)
    return torch.where(hand.movable, q, hand.rest)


@dataclass(frozen=True)
class Drawn(Rows):
    """What is random about n starts, on the CPU."""

    joints: Float[Tensor, "n n_dof"]
    aim: Float[Tensor, "n 3"]  # where palms aim [m]
    rotation: Float[Tensor, "n 3 3"]
    gap: Float[Tensor, " n"]  # distance between hand and object at which the approach ends [m]
    back: Float[Tensor, " n"]  # how far back it begins [m]


def draw_starts(
    hand: Hand, surface: Float[Tensor, "k 3"], centre: Float[Tensor, "3"], n: int, config: StartConfig,
    generator: torch.Generator, surroundings: Surroundings | None = None,
) -> Drawn:
    """All that is random about n starts, drawn on the CPU.

    Each palm aims at a point between the object's centre and a random surface point [m], from a random side with a random roll.
    In surroundings, more palms are turned than are needed, and those with most room start.
    """
    q = start_joints(hand, n, config, generator)
    wanted, middle = surface, centre
    if (place := Balls.of(config.contact_region)) is not None:
        wanted = surface[place.distances(surface)[0] <= 0]
        middle = wanted.mean(0)
    pick = torch.randint(len(wanted), (n,), generator=generator)
    aim = middle + config.aim * torch.rand(n, 1, generator=generator) * (wanted[pick] - middle)
    rotation = clearest_rotations(hand, q, aim, config, generator, surroundings)
    low, high = config.gap
    gap = low + (high - low) * torch.rand(n, generator=generator)
    reach = float((surface - centre).norm(dim=-1).max())
    size = float((hand.points(q) - hand.grasp_centre_wrist).norm(dim=-1).max())
    return Drawn(q, aim, rotation, gap, torch.full_like(gap, 2 * reach + config.clearance * size))


def approach(
    hand: Hand, field: DistanceField | DistanceFields, drawn: Drawn, config: StartConfig,
    surroundings: Surroundings | None = None,
) -> tuple[Float[Tensor, "n 4 4"], Float[Tensor, "n n_dof"]]:
    """Wrist poses and joints to start from, of hands that were drawn; everything is on one device.

    Each palm approaches until the hand is within the gap or the point is enclosed; what would start under a plane is lifted.
    """
    q, aim, rotation, gap, back = drawn.joints, drawn.aim, drawn.rotation, drawn.gap, drawn.back
    points = hand.points(q)
    direction = rotation @ hand.palm_direction_wrist
    offset = aim - rotation @ hand.grasp_centre_wrist
    body = rotate(rotation[:, None], points) + offset[:, None]
    for _ in range(config.approach_steps):
        distance = field.distances(body - (back[:, None] * direction)[:, None])[0].amin(-1)
        back = (back - (distance - gap).clamp_min(0)).clamp_min(0)
    offset = offset - back[:, None] * direction
    if surroundings is not None:
        offset = offset + surroundings.lift(rotate(rotation[:, None], points) + offset[:, None], CLEAR)
    return compose(rotation, offset), q


def clearest_rotations(
    hand: Hand, q: Float[Tensor, "n n_dof"], aim: Float[Tensor, "n 3"], config: StartConfig, generator: torch.Generator,
    surroundings: Surroundings | None,
) -> Float[Tensor, "n 3 3"]:
    """Wrist rotations of hands that aim at points; of several for each, the one that has most room in the surroundings."""
    n, up = len(aim), None if surroundings is None else surroundings.up
    spread = Spread(config.direction_spread, config.max_tilt)
    if surroundings is None:
        return wrist_rotations(hand, n, config.direction, spread, generator)
    rotations = wrist_rotations(hand, n * CHOICES, config.direction, spread, generator, up)
    rotations = rotations.unflatten(0, (n, CHOICES))
    placed = compose(rotations, aim[:, None] - rotations @ hand.grasp_centre_wrist)
    lack = approach_cost(hand, placed, hand.points(q)[:, None], None if config.max_tilt else config.direction, surroundings)
    return rotations[torch.arange(n), lack.argmin(1)]
