"""Rigid motions as 4x4 matrices: the verbs that the package needs, over roma."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.geometry.rotations import roma


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
    # torch.broadcast_shapes would import sympy, and takes longer.
    batch = torch.broadcast_tensors(rotation[..., 0], translation)[0].shape[:-1]
    top = torch.cat([rotation.expand(*batch, 3, 3), translation.expand(*batch, 3)[..., None]], -1)
    bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*batch, 1, 4)
    return torch.cat([top, bottom], -2)


def invert(T: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """The inverse motion, by the transpose of the rotation."""
    back = T[..., :3, :3].mT
    return compose(back, -(back @ T[..., :3, 3:])[..., 0])


def turned_about(
    T: Float[Tensor, "n 4 4"], pivot: Float[Tensor, "n 3"], move: Float[Tensor, "n 3"], turn: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 4 4"]:
    """Poses turned about a pivot by a rotation vector [rad], and then shifted by `move` [m]."""
    rotation = roma.rotvec_to_rotmat(turn)
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
