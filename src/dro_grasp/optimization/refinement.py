"""Polish grasps, however they were made, by a short descent of the grasp energy that stays near them.

Differs from the paper, which takes grasps as its solver leaves them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import roma
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.energy.grasp_energy import EnergyConfig, Evaluation, GraspEnergy
from dro_grasp.energy.object_energy import nearest_contacts, object_energy
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import completed
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimization.synthesis import moved


@dataclass(frozen=True)
class RefineConfig:
    """How grasps are polished, and how far they may move."""

    steps: int = 40
    """Steps of the descent."""
    farthest: float = 0.02
    """Farthest that the grasp centre may end from where it was predicted [m]."""
    largest_turn: float = math.radians(15)
    """Largest rotation of the hand away from the prediction [rad]."""
    largest_bend: float = 0.5
    """Largest change of a joint [rad; for sliding joints in their tree's unit]."""
    reach: float = 0.03
    """A finger that is farther than this from the surface is idle and is not drawn to it [m]."""
    translation_step: float = 0.002
    """First step of the translation [m]."""
    rotation_step: float = 0.02
    """First step of the rotation [rad]."""
    joint_step: float = 0.04
    """First step of each joint [rad; for sliding joints in their tree's unit]."""
    growth: float = 1.2
    """A grasp's steps grow by this after one that lowered its energy."""
    shrinkage: float = 0.5
    """And shrink by this after one that did not, which is taken back."""
    energy: EnergyConfig = field(default_factory=lambda: EnergyConfig(penetration=500.0, hand_points=400))
    """Weights; nothing settles these grasps in simulation, so depth weighs more than in synthesis."""
    batch_size: int = 64
    """Grasps polished at once."""


def refine_grasps(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, config: RefineConfig | None = None
) -> GraspBatch:
    """The same grasps after a descent of the grasp energy that stays near them; none ends with a higher energy.

    Pregrasp and squeeze are made anew, scores are dropped: they belong to the grasps before.

    Args:
        hand: The grasps' hand.
        obj: Their object.
        grasps: Any grasps of the two.
        config: Steps and bounds.
    """
    config = config or RefineConfig()
    if not len(grasps):
        return grasps
    energy = object_energy(hand, obj, config.energy)
    with torch.no_grad():
        parts = [
            _descend(energy, T, q, config)
            for T, q in zip(
                grasps.T_object_wrist.split(config.batch_size), grasps.joints.split(config.batch_size), strict=True)
        ]
    T, q = (torch.cat(part) for part in zip(*parts, strict=True))
    moved_grasps = grasps.without("pregrasp_joints", "squeeze_joints", "score", "energy").replace(T_object_wrist=T, joints=q)
    return completed(hand, moved_grasps, energy.centre)


def _descend(
    energy: GraspEnergy, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], config: RefineConfig
) -> tuple[Float[Tensor, "n 4 4"], Float[Tensor, "n n_dof"]]:
    """Steps down the gradient, each kept where it lowers the energy, within the bounds around where it began."""
    tree = energy.hand.tree
    start, pivot = T, energy.pivot(T)
    unit = tree.joint_unit
    lower = torch.maximum(tree.lower, q - config.largest_bend * unit)
    upper = torch.minimum(tree.upper, q + config.largest_bend * unit)
    move, turn = torch.zeros(len(T), 3), torch.zeros(len(T), 3)
    pace = torch.ones(len(T), 1)
    contacts = nearest_contacts(energy, T, q, config.reach)
    now = energy(T, q, contacts)
    for _ in range(config.steps):
        slope = -torch.cat([now.by_pose, now.by_joint * unit], -1)
        shift, spin, bend = (
            part / part.norm(dim=-1, keepdim=True).clamp_min(1e-9) for part in slope.split([3, 3, len(unit)], -1))
        new_move = _within(move + pace * config.translation_step * shift, config.farthest)
        new_turn = _within(
            roma.rotmat_to_rotvec(roma.rotvec_to_rotmat(pace * config.rotation_step * spin) @ roma.rotvec_to_rotmat(turn)),
            config.largest_turn)
        # The step is that of a joint on average, whatever their number.
        new_q = q + pace * config.joint_step * len(unit) ** 0.5 * bend * unit
        new_q = torch.minimum(torch.maximum(new_q, lower), upper)
        new_T = moved(start, pivot, new_move, new_turn)
        new_contacts = nearest_contacts(energy, new_T, new_q, config.reach)
        new = energy(new_T, new_q, new_contacts)
        better = new.total < now.total
        chosen = better[:, None]
        move, turn = torch.where(chosen, new_move, move), torch.where(chosen, new_turn, turn)
        T, q = torch.where(chosen[..., None], new_T, T), torch.where(chosen, new_q, q)
        now = Evaluation(*(torch.where(chosen, getattr(new, k), getattr(now, k)) for k in ("terms", "by_pose", "by_joint")))
        pace = pace * torch.where(chosen, config.growth, config.shrinkage)
    return T, q


def _within(vector: Float[Tensor, "n 3"], length: float) -> Float[Tensor, "n 3"]:
    """Vectors shortened to a length where they are longer."""
    return vector * (length / vector.norm(dim=-1, keepdim=True).clamp_min(1e-9)).clamp_max(1.0)
