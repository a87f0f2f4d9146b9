"""Refinement: a short descent of the grasp energy that stays near each grasp, wherever the grasp comes from.

Differs from the paper, which takes grasps as its solver leaves them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dro_grasp.devices import Rows, at_once, side_by_side
from dro_grasp.geometry.se3 import roma, rotated_about
from dro_grasp.graphs import repeat
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
    batch_size: int | None = None
    """Grasps refined at once; None takes what suits the device."""


ON_CPU = 32  # Grasps refined at once on a CPU: more do not fit its cache (ours, timed)
EACH = 400e3
"""Memory of a grasp in a step [bytes]: some copies of what a few thousand points and pairs of spheres need (ours, counted)."""


def refine_grasps(energy: GraspEnergy, grasps: GraspBatch, config: RefineConfig | None = None) -> GraspBatch:
    """The grasps after the descent; none has a higher energy than before.

    Whatever belongs to the grasps before (pregrasp, squeeze, scores, energies, outcomes) is dropped. The energy has the
    weights of the configuration.
    """
    config = config or RefineConfig()
    if not len(grasps):
        return grasps
    T, q = descended(energy, grasps.T_object_wrist.to(energy.device), grasps.joints.to(energy.device), config)
    return grasps.with_poses(T.cpu(), q.cpu())


@torch.no_grad()
def descended(
    energy: GraspEnergy, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], config: RefineConfig
) -> tuple[Float[Tensor, "n 4 4"], Float[Tensor, "n n_dof"]]:
    """The same for wrist poses and joints on the energy's device, where they stay."""
    size = at_once(energy.device, ON_CPU, EACH, config.batch_size)
    rows = [slice(start, start + size) for start in range(0, len(q), size)]
    ends = side_by_side(lambda T, q, part: descend_near(energy.rows(part), T, q, config), T.split(size), q.split(size), rows)
    ended_T, ended_q = (torch.cat(part) for part in zip(*ends, strict=True))
    return ended_T, ended_q


@runtime_checkable
class Slope(Protocol):
    """What a descent needs of an energy."""

    hand: Hand

    def pivot(self, T: Float[Tensor, "n 4 4"], /) -> Float[Tensor, "n 3"]:
        """The point about which each hand turns [m]."""
        ...

    def of_nearest(self, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], reach: float, /) -> Evaluation:
        """Value and gradient, with the contacts that are nearest to the surface."""
        ...


@dataclass(frozen=True)
class _Near(Rows):
    """n grasps on their way: the start turned by `turn` about the pivot and shifted by `move`."""

    move: Float[Tensor, "n 3"]  # [m]
    turn: Float[Tensor, "n 3"]  # [rad]
    rotation: Float[Tensor, "n 3 3"]  # the same as a matrix
    T: Float[Tensor, "n 4 4"]
    q: Float[Tensor, "n n_dof"]
    value: Evaluation
    pace: Float[Tensor, "n 1"]  # factor on the first steps


def descend_near(
    energy: Slope, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], config: RefineConfig
) -> tuple[Float[Tensor, "n 4 4"], Float[Tensor, "n n_dof"]]:
    """Steps down the gradient; each is kept where it lowers the energy, within the bounds around the start."""
    hand, unit = energy.hand, energy.hand.tree.joint_unit
    start, pivot = T, energy.pivot(T)
    # No farther open than the hand opens; a grasp that is beyond already goes no farther.
    lower = torch.maximum(torch.minimum(hand.lower, q), q - config.largest_bend * unit)
    upper = torch.minimum(torch.maximum(hand.upper, q), q + config.largest_bend * unit)

    def step(now: _Near, number: Int[Tensor, "1"]) -> _Near:
        slope = -torch.cat([now.value.by_pose, now.value.by_joint * unit], -1)
        shift, spin, bend = (
            part / part.norm(dim=-1, keepdim=True).clamp_min(1e-9) for part in slope.split([3, 3, len(unit)], -1))
        move = _within(now.move + now.pace * config.translation_step * shift, config.farthest)
        turn = _within(
            roma.rotmat_to_rotvec(roma.rotvec_to_rotmat(now.pace * config.rotation_step * spin) @ now.rotation),
            config.largest_turn)
        rotation = roma.rotvec_to_rotmat(turn)
        # `bend` has unit length over all joints: scaled so that the root mean square step of a joint is joint_step.
        q = now.q + now.pace * config.joint_step * len(unit) ** 0.5 * bend * unit
        q = q.clamp(lower, upper)
        T = rotated_about(start, pivot, move, rotation)
        new = _Near(move, turn, rotation, T, q, energy.of_nearest(T, q, config.reach), now.pace)
        lowers = new.value.total < now.value.total
        pace = now.pace * torch.where(lowers[:, None], config.growth, config.shrinkage)
        return replace(new.where(lowers, now), pace=pace)

    still = torch.zeros_like(pivot)
    none, value = roma.rotvec_to_rotmat(still), energy.of_nearest(T, q, config.reach)
    end = repeat(step, _Near(still, still, none, T, q, value, torch.ones_like(pivot[:, :1])), config.steps)
    return end.T, end.q


def _within(vector: Float[Tensor, "n 3"], length: float) -> Float[Tensor, "n 3"]:
    return vector * (length / vector.norm(dim=-1, keepdim=True).clamp_min(1e-9)).clamp_max(1.0)
