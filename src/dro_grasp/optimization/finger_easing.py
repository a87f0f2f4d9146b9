"""Fingers stand clear of a surface that is an estimate: each opens alone until it leaves room, and closes with the squeeze.

A camera sees one side of an object. The other side is a guess that errs by some millimetres, and fingers that rest on the guess
end up inside the object. Wrist, pregrasp and squeeze stay. Ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.energy.grasp_energy import GraspEnergy
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.optimization.finger_closing import bending, finger_distances


@dataclass(frozen=True)
class EasingConfig:
    """How much room fingers leave (ours)."""

    clearance: float = 0.004
    """Distance from which on a finger stands clear [m]: about the error of a completed surface; 6 mm cost a little where the
    cloud is whole."""
    steps: int = 11
    """Samples of the way from the grasp to the pregrasp."""
    batch_size: int = 64
    """Grasps treated at once."""


@torch.no_grad()
def ease_fingers(energy: GraspEnergy, grasps: GraspBatch, config: EasingConfig | None = None) -> GraspBatch:
    """The grasps with fingers clear of the object, as far as their pregrasps open; wrist, pregrasp and squeeze stay.

    Args:
        energy: Of the grasps' hand on their object.
        grasps: Complete grasps of the two.
        config: Room and steps.
    """
    config = config or EasingConfig()
    if not len(grasps):
        return grasps
    parts = (grasps[slice(i, i + config.batch_size)] for i in range(0, len(grasps), config.batch_size))
    return grasps.replace(joints=torch.cat([_eased(energy, part, config) for part in parts]))


def _eased(energy: GraspEnergy, grasps: GraspBatch, config: EasingConfig) -> Float[Tensor, "n n_dof"]:
    """Joints of some of the grasps, on the CPU."""
    device, bends = energy.centre.device, bending(energy.hand)
    T, q, opened = (x.to(device) for x in (grasps.T_object_wrist, grasps.joints, grasps.pregrasp_joints))
    moves, finger = bends.any(0), bends.float().argmax(0)
    shares = torch.linspace(0, 1, config.steps, device=device)
    distances = torch.stack([finger_distances(energy, T, torch.where(moves, q + share * (opened - q), q)) for share in shares])
    # The first share at which a finger is clear; the clearest where it never is.
    first = torch.where((distances >= config.clearance).any(0), (distances >= config.clearance).float().argmax(0),
                        distances.argmax(0))
    return torch.where(moves, q + shares[first][:, finger] * (opened - q), q).cpu()
