"""Fingers stand clear of a surface that is an estimate: each opens until it leaves room, and closes with the squeeze.

A camera sees one side of an object. The other side is a guess that errs by some millimetres, and by more the farther it is from
what was seen. Fingers that rest on the guess end up inside the object. Wrist, pregrasp and squeeze stay. Ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from dro_grasp.energy.grasp_energy import GraspEnergy
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.kinds import Checked
from dro_grasp.optimization.finger_closing import body_points, finger_joints, least_by_finger


@dataclass(frozen=True)
class EasingConfig(Checked):
    """How much room fingers leave (ours)."""

    clearance: float = 0.004
    """Distance from which on a finger stands clear [m]: 6 mm cost a little where the cloud is whole."""
    unseen: float = 0.015
    """The same at most, where the surface is a guess: as far as it is from the nearest point that was seen [m]."""
    steps: int = 11
    """Samples of the way from the grasp to the pregrasp."""
    batch_size: int = 64
    """Grasps treated at once."""


@torch.no_grad()
def ease_fingers(
    energy: GraspEnergy, grasps: GraspBatch, seen: Float[np.ndarray, "m 3"] | None = None, config: EasingConfig | None = None
) -> GraspBatch:
    """The grasps with fingers clear of the object, as far as their pregrasps open; wrist, pregrasp and squeeze stay.

    Args:
        energy: Of the grasps' hand on their object.
        grasps: Complete grasps of the two.
        seen: Points of the object that were seen, where the rest is a guess [m].
        config: Room and steps.
    """
    config = config or EasingConfig()
    if not len(grasps):
        return grasps
    tree = _tree(seen)
    return grasps.replace(joints=torch.cat([_eased(energy, part, tree, config) for part in grasps.in_parts(config.batch_size)]))


@torch.no_grad()
def lacking_room(
    energy: GraspEnergy, grasps: GraspBatch, seen: Float[np.ndarray, "m 3"] | None = None, config: EasingConfig | None = None
) -> Float[Tensor, " n"]:
    """How much less room the opened hands leave than fingers should, where it is least, palm included [m]; 0 for none.

    Args:
        energy: Of the grasps' hand on their object.
        grasps: Complete grasps of the two.
        seen: As in `ease_fingers`.
        config: Room.
    """
    config, device = config or EasingConfig(), energy.centre.device
    lacking, tree = [torch.zeros(0)], _tree(seen)
    for part in grasps.in_parts(config.batch_size):
        _, spare = _room(energy, part.T_object_wrist.to(device), part.pregrasp_joints.to(device), tree, config)
        lacking.append((-spare).amax(-1).clamp_min(0).cpu())
    return torch.cat(lacking)


def _tree(seen: Float[np.ndarray, "m 3"] | None) -> KDTree | None:
    return None if seen is None else KDTree(seen)


def _eased(energy: GraspEnergy, grasps: GraspBatch, seen: KDTree | None, config: EasingConfig) -> Float[Tensor, "n n_dof"]:
    """Joints of some of the grasps, on the CPU."""
    device, hand = energy.centre.device, energy.hand
    T, q, opened = (x.to(device) for x in (grasps.T_object_wrist, grasps.joints, grasps.pregrasp_joints))
    moved = finger_joints(hand)
    bends = moved.any(0) & hand.movable & ~hand.abduction
    stays = ~(hand.tree.moves & bends).any(-1)[energy.body.members.argmax(-1)]
    shares = torch.linspace(0, 1, config.steps, device=device)
    gaps, spares = [], []
    for share in shares:
        distance, spare = _room(energy, T, torch.where(bends, q + share * (opened - q), q), seen, config)
        gaps.append(least_by_finger(energy, distance.masked_fill(stays, torch.inf)))
        spares.append(least_by_finger(energy, spare.masked_fill(stays, torch.inf)))
    gap, spare = torch.stack(gaps), torch.stack(spares)
    # The first share at which a finger is clear; else the one at which it is clearest, of those as far from the surface itself
    # as they have to be at least. Fingers that share a joint open alike.
    spare = torch.where(gap >= gap.amax(0).clamp_max(config.clearance), spare, -torch.inf)
    first = torch.where((spare >= 0).any(0), (spare >= 0).float().argmax(0), spare.argmax(0))
    share = torch.where(moved, shares[first][..., None], 0).amax(1)
    return torch.where(bends, q + share * (opened - q), q).cpu()


def _room(
    energy: GraspEnergy, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], seen: KDTree | None, config: EasingConfig
) -> tuple[Float[Tensor, "n p"], Float[Tensor, "n p"]]:
    """Distance of each of the hand's surface points to the object, and how much more room it leaves than it should [m]."""
    points = body_points(energy, T, q)
    distance = energy.field.distances(points)[0]
    if seen is None:
        return distance, distance - config.clearance
    # The surface there is as much of a guess as it is farther away than what was seen.
    away = torch.from_numpy(seen.query(points.flatten(0, 1).cpu().numpy())[0]).to(distance).view_as(distance)
    guessed = away - distance.clamp_min(0)
    return distance, distance - guessed.clamp(config.clearance, max(config.clearance, config.unseen))
