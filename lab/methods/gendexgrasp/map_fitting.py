"""A hand fitted to contact maps: many particles a map descend at once, and the one of lowest energy is the grasp.

Source: GenDexGrasp (Li et al. 2023), section III-D.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.geometry.distance_field import DistanceField
from dro_grasp.geometry.se3 import apply_to_cloud, compose, random_rotations, roma, rotate
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import Checked
from lab.methods.gendexgrasp.contact_maps import FITTING_GAMMA, contact_map


@dataclass(frozen=True)
class FittingConfig(Checked):
    """The descent; the numbers are GenDexGrasp's, unless stated otherwise."""

    gamma: float = FITTING_GAMMA
    """How much points beside the normal count as farther away."""
    particles: int = 32
    """Descents for each map."""
    steps: int = 100
    """Steps of Adam."""
    rate: float = 5e-3
    """Adam's step for each coordinate [m, rad, or m of a sliding joint]."""
    penetration: float = 100.0
    """Weight of the mean penetration of the hand's points [1/m]."""
    limits: float = 1.0
    """Weight of the sum of joints beyond their limits [1/rad or 1/m]."""
    hand_points: int = 256
    """Points of the hand (GenDexGrasp: 64 a link; fewer, spread evenly, cost less)."""
    apart: float = 1.0
    """Distance of the palm from the object's centre at the start [radius of the object]."""
    batch_size: int = 4
    """Maps that are fitted together (ours)."""


@dataclass(frozen=True)
class MapTarget:
    """An object and the maps that a hand is to leave on it."""

    points: Float[Tensor, "m 3"]
    """Points of the object's surface [m]."""
    normals: Float[Tensor, "m 3"]
    goals: Float[Tensor, "k m"]
    """Contact of each point, one row for each grasp."""
    field: DistanceField
    """Signed distances of the object."""


def fit(
    hand: Hand, target: MapTarget, config: FittingConfig, generator: torch.Generator
) -> tuple[Float[Tensor, "k 4 4"], Float[Tensor, "k n_dof"], Float[Tensor, " k"]]:
    """Wrist pose, joints and energy of the best particle of each map.

    Args:
        hand: With the points that leave the map.
        target: Object and maps.
        config: The descent.
        generator: Source of the starts, on the CPU.
    """
    parts = []
    for goals in target.goals.split(config.batch_size):
        T, q = _starts(hand, target.points, len(goals) * config.particles, config, generator)
        repeated = goals.repeat_interleave(config.particles, 0)
        T, q, energy = _descend(hand, target, repeated, T, q, config)
        rows = torch.arange(len(goals)) * config.particles + energy.unflatten(0, (len(goals), -1)).argmin(1)
        parts.append((T[rows], q[rows], energy[rows]))
    T, q, energy = (torch.cat(part) for part in zip(*parts, strict=True))
    return T, q, energy


def _starts(
    hand: Hand, points: Float[Tensor, "m 3"], count: int, config: FittingConfig, generator: torch.Generator
) -> tuple[Float[Tensor, "count 4 4"], Float[Tensor, "count n_dof"]]:
    """Palms that face the object from random sides, joints in the open half of their range."""
    centre = points.mean(0)
    radius = float((points - centre).norm(dim=-1).max())
    rotation = random_rotations(count, generator)
    palm = centre - config.apart * radius * (rotation @ hand.palm_direction_wrist)
    T = compose(rotation, palm - rotation @ hand.palm_centre_wrist)
    share = 0.5 * torch.rand(count, hand.tree.n_dof, generator=generator)
    q = torch.where(hand.movable, hand.open_ends + share * (hand.closed_ends - hand.open_ends), hand.rest)
    return T, q


@torch.enable_grad()  # the benchmark asks sources without gradients
def _descend(
    hand: Hand, target: MapTarget, goals: Float[Tensor, "n m"], T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"],
    config: FittingConfig,
) -> tuple[Float[Tensor, "n 4 4"], Float[Tensor, "n n_dof"], Float[Tensor, " n"]]:
    """Adam on the wrist's shift and turn about the palm, and on the joints; energies are those of the end."""
    free = hand.movable.to(q)
    start, joints = T, q
    # A turn of exactly zero has no gradient in every version of roma.
    move, turn, bend = torch.zeros(len(q), 3), torch.full((len(q), 3), 1e-6), torch.zeros_like(q)
    optimiser = torch.optim.Adam([move.requires_grad_(), turn.requires_grad_(), bend.requires_grad_()], lr=config.rate)
    pivot = start[:, :3, 3] + rotate(start[:, :3, :3], hand.palm_centre_wrist)
    energy = torch.zeros(len(q))
    for step in range(config.steps + 1):
        rotation = roma.rotvec_to_rotmat(turn)
        T = compose(rotation @ start[:, :3, :3], rotate(rotation, start[:, :3, 3] - pivot) + pivot + move)
        q = joints + bend * free
        energy = map_energy(hand, target, goals, T, q, config)
        if step < config.steps:
            optimiser.zero_grad()
            energy.sum().backward()
            optimiser.step()
    return T.detach(), q.detach().clamp(hand.lower, hand.upper), energy.detach()


def map_energy(
    hand: Hand, target: MapTarget, goals: Float[Tensor, "n m"], T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"],
    config: FittingConfig,
) -> Float[Tensor, " n"]:
    """How far hands are from leaving their maps, with penetration and joints beyond their limits."""
    body = apply_to_cloud(T, hand.points(q))
    contact = contact_map(target.points, target.normals, body, config.gamma)
    inside = (-target.field.distances(body)[0]).clamp_min(0).mean(-1)
    beyond = (q - hand.upper).clamp_min(0).sum(-1) + (hand.lower - q).clamp_min(0).sum(-1)
    apart = (contact - goals).abs().mean(-1)
    return apart + config.penetration * inside + config.limits * beyond

