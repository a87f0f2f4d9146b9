"""Directions of palms: random wrist rotations near a wanted direction, and the room that a hand has along it."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.energy.grasp_energy import EnergyConfig
from dro_grasp.energy.surroundings import Surroundings
from dro_grasp.geometry.se3 import apply_to_cloud, random_rotations, roma, rotation_between
from dro_grasp.hands.hand import Hand

Direction = tuple[float, float, float]
"""A vector in the object's frame, of any length but zero."""
CLEAR = EnergyConfig.clear
"""Distance from its surroundings at which a hand starts [m]: the one that it keeps later."""
LARGEST_TILT = math.radians(60.0)
"""How far palms tilt from the wanted direction towards a plane, where the hand needs room [rad] (ours)."""
TILT_COST = 0.03
"""Depth in the surroundings that a tilt of one radian is worth [m/rad] (ours)."""
APPROACH = 0.10
"""Length of the straight approach along the palm direction, which a hand has room for [m] (ours)."""
ROOM_POINTS = 96
"""Hand points, spread evenly, at which room is measured (ours)."""


def lack_of_room(
    hand: Hand, T: Float[Tensor, "*b 4 4"], points: Float[Tensor, "*n p 3"], direction: Direction | None,
    surroundings: Surroundings,
) -> Float[Tensor, "*b"]:
    """How deep hands get into their surroundings on a straight approach [m], and for how much of a tilt from the direction.

    Args:
        hand: The hand.
        T: Wrist poses [m].
        points: The hand's surface points in the wrist frame [m].
        direction: The palm direction that was wanted; tilts from it cost something.
        surroundings: What the hand stays clear of.
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

    deviation: float
    """Standard deviation [rad]."""
    cone: float | None = None
    """Evenly within a cone of this half angle instead [rad]."""


def wrist_rotations(
    hand: Hand, count: int, direction: Direction | None, spread: Spread, generator: torch.Generator,
    up: Float[Tensor, "3"] | None = None,
) -> Float[Tensor, "count 3 3"]:
    """Random wrist rotations: uniform, or with the palm near a direction and any roll.

    Args:
        hand: The hand; its device is the result's.
        count: How many.
        direction: Palm direction in the object's frame.
        spread: Of palm directions around it.
        generator: Source of randomness, on the CPU.
        up: Normal of a plane towards which palms also tilt, by up to LARGEST_TILT; not in a cone.
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
    if spread.cone is not None:
        height = 1 - torch.rand(count, 1, generator=generator) * (1 - math.cos(spread.cone))
        tilt = torch.nn.functional.normalize(tilt, dim=-1) * torch.acos(height)
    elif up is not None:
        axis, most = _tilt(wanted, up.cpu())
        tilt = tilt + torch.rand(count, 1, generator=generator) * most * axis
    return (roma.rotvec_to_rotmat(tilt) @ roma.rotvec_to_rotmat(roll[:, None] * wanted) @ align).to(palm)
