"""The object as the optimiser feels it: signed distance, normal and curvature by one look-up a point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple
from weakref import WeakKeyDictionary

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from dro_grasp.geometry.signed_distance import SignedDistanceGrid

BLUR = (0.25, 0.5, 0.25)
"""Weights along each axis by which the normals' field is smoothed; edges of a voxel grid are not edges."""


class SurfaceModel(NamedTuple):
    """The object's surface as seen from some points."""

    distance: Tensor
    """Signed distance (*b) [m]."""
    gradient: Tensor
    """Its gradient (*b 3), about a unit vector."""
    normal: Tensor
    """The gradient's direction: the outward normal (*b 3)."""
    bend: Tensor
    """The normal's derivative by position (*b 3 3) [1/m]."""


@dataclass(frozen=True)
class DistanceField:
    """Second-order model of the signed distance around every voxel of a grid."""

    slopes: Float[Tensor, "voxels 4"]
    """Per voxel: distance [m] and unit gradient."""
    curvatures: Float[Tensor, "voxels 9"]
    """Per voxel: symmetric derivative of the gradient [1/m]."""
    shape: tuple[int, int, int]
    """Voxels per axis."""
    origin: Float[Tensor, 3]
    """Position of the first voxel [m]."""
    spacing: float
    """Edge of a voxel [m]."""

    @staticmethod
    def from_grid(grid: SignedDistanceGrid, dtype: torch.dtype = torch.float32) -> DistanceField:
        """Derive gradients and curvature from a grid of signed distances."""
        values = grid.values.to(dtype)
        gradient = _differences(_smooth(values), grid.spacing)
        gradient = gradient / gradient.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        columns = [_differences(gradient[..., k], grid.spacing) for k in range(3)]
        curvature = torch.stack(columns, -2)
        curvature = (0.5 * (curvature + curvature.mT)).clamp(-0.5 / grid.spacing, 0.5 / grid.spacing)
        # Beyond the grid the model is linear.
        for axis in range(3):
            for end in (0, -1):
                curvature.select(axis, end).zero_()
        slopes = torch.cat([values[..., None], gradient], -1).flatten(0, 2)
        shape = (values.shape[0], values.shape[1], values.shape[2])
        origin = grid.origin.to(dtype)
        curvatures = curvature.flatten(-2).flatten(0, 2).contiguous()
        return DistanceField(slopes, curvatures, shape, origin, float(grid.spacing))

    @staticmethod
    def of(grid: SignedDistanceGrid) -> DistanceField:
        """The field of a grid in single precision, made once for each grid object."""
        if grid not in _FIELDS:
            _FIELDS[grid] = DistanceField.from_grid(grid)
        return _FIELDS[grid]

    def distances(
        self, points: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        """Signed distance [m] and its gradient: nearest voxel and first order; linear beyond the grid."""
        row, offset = self._locate(points)
        near = self.slopes.index_select(0, row.flatten()).reshape(*points.shape[:-1], 4)
        gradient = near[..., 1:]
        return near[..., 0] + (gradient * offset).sum(-1), gradient

    def normals(
        self, points: Float[Tensor, "*b 3"]
    ) -> SurfaceModel:
        """Second-order model at the nearest voxel, consistent: each part is the derivative of the one before."""
        row, offset = self._locate(points)
        near, curvature = self.slopes[row], self.curvatures[row].unflatten(-1, (3, 3))
        gradient = near[..., 1:]
        turned = (curvature @ offset[..., None])[..., 0]
        distance = near[..., 0] + (gradient * offset).sum(-1) + 0.5 * (turned * offset).sum(-1)
        raw = gradient + turned
        length = raw.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        normal = raw / length
        tangent = curvature - normal[..., :, None] * (normal[..., None, :] @ curvature)
        return SurfaceModel(distance, raw, normal, tangent / length[..., None])

    def _locate(self, points: Float[Tensor, "*b 3"]) -> tuple[Tensor, Float[Tensor, "*b 3"]]:
        place = (points - self.origin) / self.spacing
        top = place.new_tensor(self.shape) - 1
        index = torch.minimum(place.round().clamp_min(0), top)
        offset = (place - index) * self.spacing
        strides = place.new_tensor([self.shape[1] * self.shape[2], self.shape[2], 1])
        return (index @ strides).to(torch.int64), offset


_FIELDS: WeakKeyDictionary[SignedDistanceGrid, DistanceField] = WeakKeyDictionary()


def _smooth(values: Float[Tensor, "x y z"]) -> Float[Tensor, "x y z"]:
    kernel = values.new_tensor(BLUR)
    result = values[None, None]
    for axis in range(3):
        shape = [1, 1, 1, 1, 1]
        shape[2 + axis] = 3
        pad = [0, 0, 0, 0, 0, 0]
        pad[2 * (2 - axis)] = pad[2 * (2 - axis) + 1] = 1
        result = F.conv3d(F.pad(result, pad, mode="replicate"), kernel.reshape(shape))
    return result[0, 0]


def _differences(values: Float[Tensor, "x y z"], spacing: float) -> Float[Tensor, "x y z 3"]:
    return torch.stack(torch.gradient(values, spacing=spacing), -1)
