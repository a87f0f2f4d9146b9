"""Refinement: a short descent of the grasp energy that stays near each grasp, wherever the grasp comes from.

Differs from the paper, which takes grasps as its solver leaves them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dro_grasp.devices import side_by_side
from dro_grasp.geometry.se3 import roma, turned_about
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import Checked
from dro_grasp.optimize.fingers import ClosingConfig
from dro_grasp.optimize.grasp_energy import EnergyConfig, Evaluation, GraspEnergy
from dro_grasp.optimize.squeeze import GripConfig


@dataclass(frozen=True)
class RefineConfig(Checked):
    """Steps of the descent, and how far a grasp may move (ours)."""

    steps: int = 40
    """Steps of the descent."""
    farthest: float = 0.02
    """Largest displacement of the grasp centre [m]."""
    largest_turn: float = math.radians(15)
    """Largest rotation of the hand [rad]."""
    largest_bend: float = 0.5
    """Largest change of a joint [rad; for sliding joints in their tree's unit]."""
    reach: float = 0.03
    """The descent does not draw in a finger farther than this from the surface [m]."""
    translation_step: float = 0.002
    """First step of the translation [m]."""
    rotation_step: float = 0.02
    """First step of the rotation [rad]."""
    joint_step: float = 0.04
    """First step of each joint [rad; for sliding joints in their tree's unit]."""
    growth: float = 1.2
    """Factor on a grasp's step lengths after a step that lowered its energy."""
    shrinkage: float = 0.5
    """Factor after a step that did not, which is undone."""
    energy: EnergyConfig = field(default_factory=lambda: EnergyConfig(
        penetration=500.0, self_penetration=500.0, hand_points=400, filled=True, clearance=500.0, clearance_points=512))
    """Weights; no simulation settles these grasps, so penetration weighs more than in synthesis."""
    closing: ClosingConfig = field(default_factory=ClosingConfig)
    """How idle fingers close before the descent."""
    grip: GripConfig = field(default_factory=GripConfig)
    """How the squeeze is made after it."""
    batch_size: int = 32
    """Grasps refined at once."""


def refine_grasps(energy: GraspEnergy, grasps: GraspBatch, config: RefineConfig | None = None) -> GraspBatch:
    """The grasps after the descent; none has a higher energy than before.

    Whatever belongs to the grasps before (pregrasp, squeeze, scores, energies, outcomes) is dropped. The energy has the
    weights of the configuration.
    """
    config = config or RefineConfig()
    if not len(grasps):
        return grasps
    device = energy.centre.device
    parts = (column.to(device).split(config.batch_size) for column in (grasps.T_object_wrist, grasps.joints))
    with torch.no_grad():
        ends = side_by_side(lambda T, q: descend_near(energy, T, q, config), *parts)
    T, q = (torch.cat(part).cpu() for part in zip(*ends, strict=True))
    return grasps.with_poses(T, q)


@runtime_checkable
class Slope(Protocol):
    """What a descent needs of an energy."""

    hand: Hand

    def pivot(self, T: Float[Tensor, "n 4 4"], /) -> Float[Tensor, "n 3"]:
        """The point about which each hand turns [m]."""
        ...

    def nearest_contacts(self, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], reach: float, /) -> Int[Tensor, "n c"]:
        """Its contacts."""
        ...

    def __call__(self, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], contacts: Int[Tensor, "n c"], /) -> Evaluation:
        """Value and gradient."""
        ...


def descend_near(
    energy: Slope, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], config: RefineConfig
) -> tuple[Float[Tensor, "n 4 4"], Float[Tensor, "n n_dof"]]:
    """Steps down the gradient; each is kept where it lowers the energy, within the bounds around the start."""
    hand, unit = energy.hand, energy.hand.tree.joint_unit
    start, pivot = T, energy.pivot(T)
    # No farther open than the hand opens; a grasp that is beyond already goes no farther.
    lower = torch.maximum(torch.minimum(hand.lower, q), q - config.largest_bend * unit)
    upper = torch.minimum(torch.maximum(hand.upper, q), q + config.largest_bend * unit)
    # The pose is the start turned by `turn` about the pivot and shifted by `move`: both are bounded as they stand.
    move, turn = torch.zeros_like(pivot), torch.zeros_like(pivot)
    pace = torch.ones_like(pivot[:, :1])
    contacts = energy.nearest_contacts(T, q, config.reach)
    now = energy(T, q, contacts)
    for _ in range(config.steps):
        slope = -torch.cat([now.by_pose, now.by_joint * unit], -1)
        shift, spin, bend = (
            part / part.norm(dim=-1, keepdim=True).clamp_min(1e-9) for part in slope.split([3, 3, len(unit)], -1))
        new_move = _within(move + pace * config.translation_step * shift, config.farthest)
        new_turn = _within(
            roma.rotmat_to_rotvec(roma.rotvec_to_rotmat(pace * config.rotation_step * spin) @ roma.rotvec_to_rotmat(turn)),
            config.largest_turn)
        # `bend` has unit length over all joints: scaled so that the root mean square step of a joint is joint_step.
        new_q = q + pace * config.joint_step * len(unit) ** 0.5 * bend * unit
        new_q = new_q.clamp(lower, upper)
        new_T = turned_about(start, pivot, new_move, new_turn)
        new_contacts = energy.nearest_contacts(new_T, new_q, config.reach)
        new = energy(new_T, new_q, new_contacts)
        lower_energy = new.total < now.total
        chosen = lower_energy[:, None]
        move, turn = torch.where(chosen, new_move, move), torch.where(chosen, new_turn, turn)
        T, q = torch.where(chosen[..., None], new_T, T), torch.where(chosen, new_q, q)
        now = new.where(lower_energy, now)
        pace = pace * torch.where(chosen, config.growth, config.shrinkage)
    return T, q


def _within(vector: Float[Tensor, "n 3"], length: float) -> Float[Tensor, "n 3"]:
    return vector * (length / vector.norm(dim=-1, keepdim=True).clamp_min(1e-9)).clamp_max(1.0)
