"""Where synthesis starts: palms that face the object from all sides, fingers half open, nothing inside."""

from __future__ import annotations

from dataclasses import dataclass

import roma
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.geometry.distance_field import DistanceField
from dro_grasp.hands.hand import Hand


@dataclass(frozen=True)
class StartConfig:
    """How starts are spread. Source of the scheme: DexGraspNet; the numbers are ours."""

    openness: tuple[float, float] = (0.0, 1.0)
    """Range of the share of the way from closed to open, one draw a grasp."""
    joint_noise: float = 0.6
    """Standard deviation of each joint, as a share of its range; many joints start at a limit. (Small noise makes all
    grasps of an object alike: 0.08 halves the spread of the joints and yields no more.)"""
    aim: float = 0.6
    """Largest share of the way from the object's centre to a random surface point at which the palm aims."""
    gap: tuple[float, float] = (0.0, 0.01)
    """Range of the distance between hand and object [m]."""
    clearance: float = 0.6
    """How far outside the object's bounding sphere the approach begins [radius of the hand]."""
    approach_steps: int = 24
    """Steps of the approach along the palm direction."""


def random_rotations(n: int, generator: torch.Generator, dtype: torch.dtype) -> Float[Tensor, "n 3 3"]:
    """Rotations uniform on SO(3)."""
    quaternion = torch.randn(n, 4, generator=generator, dtype=dtype)
    return roma.unitquat_to_rotmat(quaternion / quaternion.norm(dim=-1, keepdim=True))


def start_joints(
    hand: Hand, n: int, config: StartConfig, generator: torch.Generator
) -> Float[Tensor, "n n_dof"]:
    """Partly closed hands with some noise on every joint, within limits [rad or m]."""
    low, high = config.openness
    share = low + (high - low) * torch.rand(n, 1, generator=generator)
    opened, closed = hand.canonical_joints(1.0), hand.canonical_joints(0.0)
    q = opened * share + closed * (1 - share)
    span = hand.tree.upper - hand.tree.lower
    q = q + config.joint_noise * span * torch.randn(n, hand.tree.n_dof, generator=generator)
    q = torch.minimum(torch.maximum(q, hand.tree.lower), hand.tree.upper)
    return torch.where(hand.movable, q, hand.rest)


def starts(
    hand: Hand,
    field: DistanceField,
    surface: Float[Tensor, "k 3"],
    centre: Float[Tensor, 3],
    n: int,
    config: StartConfig,
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
        config: How they are spread.
        generator: Source of randomness.
    """
    q = start_joints(hand, n, config, generator)
    points = hand.points(q)
    rotation = random_rotations(n, generator, q.dtype)
    pick = torch.randint(len(surface), (n,), generator=generator)
    aim = centre + config.aim * torch.rand(n, 1, generator=generator) * (surface[pick] - centre)
    direction = rotation @ hand.palm_direction_wrist
    offset = aim - rotation @ hand.grasp_centre_wrist
    reach = float((surface - centre).norm(dim=-1).max())
    size = float((points - hand.grasp_centre_wrist).norm(dim=-1).max())
    low, high = config.gap
    gap = low + (high - low) * torch.rand(n, generator=generator)
    body = (rotation[:, None] @ points[..., None])[..., 0] + offset[:, None]
    back = torch.full((n,), 2 * reach + config.clearance * size, dtype=q.dtype)
    for _ in range(config.approach_steps):
        distance = field.distances(body - (back[:, None] * direction)[:, None])[0].amin(-1)
        back = (back - (distance - gap).clamp_min(0)).clamp_min(0)
    T = torch.eye(4, dtype=q.dtype).repeat(n, 1, 1)
    T[:, :3, :3], T[:, :3, 3] = rotation, offset - back[:, None] * direction
    return T, q
