"""Starts of synthesis: palms that face the object from all sides, fingers half open, nothing in penetration."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.geometry.distance_field import DistanceField
from dro_grasp.geometry.rotations import roma
from dro_grasp.geometry.se3 import compose, random_rotations, rotate, rotation_between
from dro_grasp.hands.hand import Hand

Direction = tuple[float, float, float]
"""A vector in the object's frame, of any length but zero."""


@dataclass(frozen=True)
class StartConfig:
    """Distribution of the starts. Source of the scheme: DexGraspNet; the numbers are ours."""

    openness: tuple[float, float] = (0.0, 1.0)
    """Range of the share of the way from closed to open, one draw a grasp."""
    joint_noise: float = 0.6
    """Standard deviation of each joint, as a share of its range; many joints start at a limit. (0.08 halves the diversity of
    the joints and yields no more.)"""
    aim: float = 0.6
    """Largest share of the way from the object's centre to a random surface point at which the palm aims."""
    direction: Direction | None = None
    """Palm direction in the object's frame; any by default."""
    direction_spread: float = math.radians(5.0)
    """Standard deviation of the palm direction around the given one [rad]."""
    gap: tuple[float, float] = (0.0, 0.01)
    """Range of the distance between hand and object [m]."""
    clearance: float = 0.6
    """How far outside the object's bounding sphere the approach begins [radius of the hand]."""
    approach_steps: int = 24
    """Steps of the approach along the palm direction."""


def start_joints(hand: Hand, n: int, config: StartConfig, generator: torch.Generator) -> Float[Tensor, "n n_dof"]:
    """Partly closed hands with some noise on every joint, no farther open than the hand opens [rad or m]."""
    low, high = config.openness
    share = low + (high - low) * torch.rand(n, 1, generator=generator)
    opened, closed = hand.canonical_joints(1.0), hand.canonical_joints(0.0)
    q = opened * share + closed * (1 - share)
    span = hand.upper - hand.lower
    q = q + config.joint_noise * span * torch.randn(n, hand.tree.n_dof, generator=generator)
    q = torch.minimum(torch.maximum(q, hand.lower), hand.upper)
    return torch.where(hand.movable, q, hand.rest)


def starts(
    hand: Hand, field: DistanceField, surface: Float[Tensor, "k 3"], centre: Float[Tensor, 3], n: int, config: StartConfig,
    generator: torch.Generator,
) -> tuple[Float[Tensor, "n 4 4"], Float[Tensor, "n n_dof"]]:
    """Wrist poses and joints to start from.

    Each palm aims at a point between the object's centre and a random surface point, from a random side
    with a random roll, and approaches until the hand is within the gap or the point is enclosed.

    Args:
        hand: The hand.
        field: Signed distances of the object.
        surface: Points of its surface [m].
        centre: Its centre of mass [m].
        n: How many.
        config: Their distribution.
        generator: Source of randomness.
    """
    q = start_joints(hand, n, config, generator)
    points = hand.points(q)
    rotation = wrist_rotations(hand, n, config.direction, config.direction_spread, generator)
    pick = torch.randint(len(surface), (n,), generator=generator)
    aim = centre + config.aim * torch.rand(n, 1, generator=generator) * (surface[pick] - centre)
    direction = rotation @ hand.palm_direction_wrist
    offset = aim - rotation @ hand.grasp_centre_wrist
    reach = float((surface - centre).norm(dim=-1).max())
    size = float((points - hand.grasp_centre_wrist).norm(dim=-1).max())
    low, high = config.gap
    gap = low + (high - low) * torch.rand(n, generator=generator)
    body = rotate(rotation[:, None], points) + offset[:, None]
    back = torch.full((n,), 2 * reach + config.clearance * size, dtype=q.dtype)
    for _ in range(config.approach_steps):
        distance = field.distances(body - (back[:, None] * direction)[:, None])[0].amin(-1)
        back = (back - (distance - gap).clamp_min(0)).clamp_min(0)
    return compose(rotation, offset - back[:, None] * direction), q


def wrist_rotations(
    hand: Hand, count: int, direction: Direction | None, spread: float, generator: torch.Generator
) -> Float[Tensor, "count 3 3"]:
    """Random wrist rotations: uniform, or with the palm near a direction and any roll.

    Args:
        hand: The hand; its device is the result's.
        count: How many.
        direction: Palm direction in the object's frame.
        spread: Standard deviation of the palm direction around it [rad].
        generator: Source of randomness, on the CPU.
    """
    palm = hand.palm_direction_wrist
    if direction is None:
        return random_rotations(count, generator).to(palm)
    wanted = torch.tensor(direction, dtype=torch.float32)
    wanted = wanted / wanted.norm()
    roll = torch.rand(count, generator=generator) * 2 * math.pi
    tilt = torch.randn(count, 3, generator=generator) * spread
    tilt = tilt - (tilt @ wanted)[:, None] * wanted
    align = rotation_between(palm.cpu(), wanted)
    return (roma.rotvec_to_rotmat(tilt) @ roma.rotvec_to_rotmat(roll[:, None] * wanted) @ align).to(palm)
