"""Postures between open and closed, of a hand whose closing is still being looked for."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.kinematics.tree import KinematicTree

AT_LIMIT = 0.1
"""Distance to a limit, as a share of the range, within which a joint is at this limit (ours)."""


@dataclass(frozen=True)
class Postures:
    """Joints, and what the hand's file states of them."""

    tree: KinematicTree
    """Links and joints."""
    rest: Float[Tensor, " n_dof"]
    """As in `Hand`."""
    movable: Bool[Tensor, " n_dof"]
    """As in `Hand`."""
    stated: Float[Tensor, " n_dof"]
    """The open posture that the hand's file states [rad or m]; NaN for joints of which it says nothing."""

    def opened(self, signs: Float[Tensor, " n_dof"]) -> Float[Tensor, " n_dof"]:
        """The stated open posture; for other joints the limits towards which they open."""
        limits = torch.where(signs > 0, self.tree.upper, self.tree.lower)
        return torch.where(self.stated.isnan(), limits, self.stated)

    def as_stated(self, signs: Float[Tensor, " n_dof"]) -> Float[Tensor, " n_dof"]:
        """The signs, but a joint whose stated open posture is a limit opens towards it."""
        return torch.where(self.stated.isnan(), signs, self.away_from_limits(self.stated, signs))

    def away_from_limits(
        self, opened: Float[Tensor, " n_dof"], signs: Float[Tensor, "*batch n_dof"]
    ) -> Float[Tensor, "*batch n_dof"]:
        """The signs, but joints that are open at one of their limits close towards the other one."""
        room = AT_LIMIT * (self.tree.upper - self.tree.lower)
        at_lower, at_upper = opened - self.tree.lower < room, self.tree.upper - opened < room
        return torch.where(at_lower, -1.0, torch.where(at_upper, 1.0, signs))

    def posture(
        self, opened: Float[Tensor, " n_dof"], signs: Float[Tensor, "*batch n_dof"], abduction: Bool[Tensor, " n_dof"],
        share: float,
    ) -> Float[Tensor, "*batch n_dof"]:
        """Joints this share of the way from open to closed; those that are held or only spread fingers at rest."""
        closed = torch.where(signs > 0, self.tree.lower, self.tree.upper)
        return torch.where(self.movable & ~abduction, opened + share * (closed - opened), self.rest)
