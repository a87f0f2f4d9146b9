"""Rigid motions as 4x4 matrices: the verbs that the package needs, over roma, and poses from corresponding points.

roma is imported here for the whole package, without PyTorch's compiler: that takes longer to import than all the rest.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

COMPILER = "torch._dynamo"
"""Module whose `disable` roma applies to two functions as it is imported; nothing here is compiled (ours)."""

if COMPILER in sys.modules:
    import roma
else:
    sys.modules[COMPILER] = ModuleType(COMPILER)
    sys.modules[COMPILER].__dict__["disable"] = lambda function: function
    try:
        import roma
    finally:
        del sys.modules[COMPILER]


def rotate(rotation: Float[Tensor, "*#b 3 3"], vectors: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*b 3"]:
    """Turn each vector by its own rotation; batch axes broadcast."""
    return (rotation @ vectors[..., None])[..., 0]


def apply(T: Float[Tensor, "*#b 4 4"], points: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*b 3"]:
    """Move each point by its own pose; batch axes broadcast."""
    return rotate(T[..., :3, :3], points) + T[..., :3, 3]


def apply_to_cloud(T: Float[Tensor, "*#b 4 4"], cloud: Float[Tensor, "*#b n 3"]) -> Float[Tensor, "*b n 3"]:
    """Move all points of a cloud by one pose: one matrix product for the whole cloud."""
    return cloud @ T[..., :3, :3].mT + T[..., None, :3, 3]


def compose(rotation: Float[Tensor, "*#b 3 3"], translation: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*b 4 4"]:
    """The pose with this rotation and this translation."""
    if rotation.shape[:-1] != translation.shape:
        # torch.broadcast_shapes would import sympy, and takes longer.
        batch = torch.broadcast_tensors(rotation[..., 0], translation)[0].shape[:-1]
        rotation, translation = rotation.expand(*batch, 3, 3), translation.expand(*batch, 3)
    top = torch.cat([rotation, translation[..., None]], -1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1
    return torch.cat([top, bottom], -2)


def invert(T: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """The inverse motion, by the transpose of the rotation."""
    back = T[..., :3, :3].mT
    return compose(back, -(back @ T[..., :3, 3:])[..., 0])


def turned_about(
    T: Float[Tensor, "n 4 4"], pivot: Float[Tensor, "n 3"], move: Float[Tensor, "n 3"], turn: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 4 4"]:
    """Poses turned about a pivot by a rotation vector [rad], and then shifted by `move` [m]."""
    return rotated_about(T, pivot, move, roma.rotvec_to_rotmat(turn))


def rotated_about(
    T: Float[Tensor, "n 4 4"], pivot: Float[Tensor, "n 3"], move: Float[Tensor, "n 3"], rotation: Float[Tensor, "n 3 3"]
) -> Float[Tensor, "n 4 4"]:
    """The same by a rotation matrix."""
    return compose(rotation @ T[:, :3, :3], rotate(rotation, T[:, :3, 3] - pivot) + pivot + move)


def random_rotations(n: int, generator: torch.Generator, dtype: torch.dtype = torch.float32) -> Float[Tensor, "n 3 3"]:
    """Rotations uniform on SO(3), on the generator's device."""
    quaternion = torch.randn(n, 4, generator=generator, dtype=dtype, device=generator.device)
    return roma.unitquat_to_rotmat(torch.nn.functional.normalize(quaternion, dim=-1))


def rotation_between(a: Float[Tensor, "3"], b: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The smallest rotation that takes unit vector a to unit vector b (some half turn if they are opposite)."""
    axis = torch.linalg.cross(a, b)
    if axis.norm() < 1e-6:
        # Any axis across a will do: the one from the coordinate axis that is farthest from a is well conditioned.
        axis = torch.linalg.cross(a, torch.eye(3).to(a)[a.abs().argmin()])
    angle = torch.atan2(torch.linalg.cross(a, b).norm(), a @ b)
    return roma.rotvec_to_rotmat(axis / axis.norm() * angle)


def register(
    source: Float[Tensor, "*b n 3"], target: Float[Tensor, "*b n 3"], weights: Float[Tensor, "*b n"] | None = None
) -> tuple[Float[Tensor, "*b 4 4"], Float[Tensor, "*b"]]:
    """The motion, never a reflection, that maps source points closest to target points: T_target_source, and the distance left.

    Points are in metres, the distance is the weighted root mean square [m]. A weight of 0 leaves a pair out; if all are zero,
    they count as one: check the rank of the points before using such a pose. roma regularises the backward pass, so gradients
    stay finite on thin and even on collinear sets. Source: paper section III-D, 6D pose estimation of links.
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
