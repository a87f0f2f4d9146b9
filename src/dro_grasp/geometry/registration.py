"""Rigid poses from corresponding points.

Source: paper section III-D, 6D pose estimation of links.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.geometry.rotations import roma
from dro_grasp.geometry.se3 import compose


def register(
    source: Float[Tensor, "*b n 3"], target: Float[Tensor, "*b n 3"], weights: Float[Tensor, "*b n"] | None = None
) -> tuple[Float[Tensor, "*b 4 4"], Float[Tensor, "*b"]]:
    """The rigid motion, never a reflection, that maps source points closest to target points.

    roma regularises the backward pass, so gradients stay finite on thin and even on collinear sets. If all weights are
    zero, they count as one: check the rank of the points before using such a pose.

    Args:
        source: Points in their own frame [m].
        target: The same points in the target frame [m].
        weights: Weight of each pair; 1 by default, 0 leaves a pair out.

    Returns:
        T_target_source, and the remaining weighted root mean square distance [m].
    """
    weights = source.new_ones(source.shape[:-1]) if weights is None else weights
    weights = torch.where(weights.sum(-1, keepdim=True) > 0, weights, torch.ones_like(weights))
    with torch.no_grad():
        # roma's regularisation is absolute and would dominate the gradients of a finger link in metres: scale the points
        # to unit size.
        share = weights / weights.sum(-1, keepdim=True)
        centred = source - (share[..., None] * source).sum(-2, keepdim=True)
        size = (share * centred.square().sum(-1)).sum(-1).sqrt().clamp(min=1e-6)[..., None]
    motion: Any = roma.rigid_points_registration(source / size[..., None], target / size[..., None], weights=share)
    rotation, shift = motion[0], motion[1] * size
    error = target - source @ rotation.mT - shift[..., None, :]
    # The root has an infinite slope at zero error; the floor is far below a micrometre.
    residual = ((error.square().sum(-1) * share).sum(-1) + 1e-16).sqrt()
    return compose(rotation, shift), residual
