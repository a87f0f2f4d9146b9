"""The object as the optimiser feels it: signed distance, normal and curvature by one look-up a point."""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from dro_grasp.geometry.signed_distance import SignedDistanceGrid

BLUR = (0.25, 0.5, 0.25)
"""Weights along each axis by which the normals' field is smoothed; edges of a voxel grid are not edges."""


@dataclass(frozen=True)
class DistanceField:
    """Second-order model of the signed distance around every voxel of a grid."""

    table: Float[Tensor, "voxels 13"]
    """Per voxel: distance [m], unit normal (3), derivative of the normal (9) [1/m]."""
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
        curvature = torch.stack(columns, -2).clamp(-0.5 / grid.spacing, 0.5 / grid.spacing)
        table = torch.cat([values[..., None], gradient, curvature.flatten(-2)], -1)
        shape = (values.shape[0], values.shape[1], values.shape[2])
        origin = grid.origin.to(dtype)
        return DistanceField(table.flatten(0, 2).contiguous(), shape, origin, float(grid.spacing))

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
        near = self.table[:, :4][row]
        gradient = near[..., 1:]
        return near[..., 0] + (gradient * offset).sum(-1), gradient

    def normals(
        self, points: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"], Float[Tensor, "*b 3 3"]]:
        """Signed distance [m], outward unit normal, and the normal's derivative by position [1/m]."""
        row, offset = self._locate(points)
        near = self.table[row]
        gradient, curvature = near[..., 1:4], near[..., 4:].unflatten(-1, (3, 3))
        distance = near[..., 0] + (gradient * offset).sum(-1)
        within = offset.clamp(-self.spacing, self.spacing)
        raw = gradient + (curvature @ within[..., None])[..., 0]
        length = raw.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        normal = raw / length
        tangent = curvature - normal[..., :, None] * (normal[..., None, :] @ curvature)
        return distance, normal, tangent / length[..., None]

    def _locate(self, points: Float[Tensor, "*b 3"]) -> tuple[Tensor, Float[Tensor, "*b 3"]]:
        place = (points - self.origin) / self.spacing
        top = place.new_tensor(self.shape) - 1
        index = torch.minimum(place.round().clamp_min(0), top)
        offset = (place - index) * self.spacing
        strides = place.new_tensor([self.shape[1] * self.shape[2], self.shape[2], 1])
        return (index @ strides).to(torch.int64), offset


_FIELDS: WeakKeyDictionary[SignedDistanceGrid, DistanceField] = WeakKeyDictionary()


@dataclass(frozen=True)
class CloudField:
    """The same queries on a bare cloud: distance to the nearest point, its normal deciding the side."""

    points: Float[Tensor, "m 3"]
    """Surface points [m]."""
    point_normals: Float[Tensor, "m 3"]
    """Outward unit normals there."""
    chunk: int = 4096
    """Queries answered at once."""

    def distances(
        self, points: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        """Signed distance [m] along the nearest point's normal close by, to the point itself far away; its gradient."""
        flat = points.reshape(-1, 3)
        index = torch.cat([torch.cdist(part, self.points).argmin(-1) for part in flat.split(self.chunk)])
        normal = self.point_normals[index].reshape(points.shape)
        apart = points - self.points[index].reshape(points.shape)
        height = (apart * normal).sum(-1)
        return height.sign() * apart.norm(dim=-1), normal

    def normals(
        self, points: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"], Float[Tensor, "*b 3 3"]]:
        """Signed distance [m], outward unit normal, and zero for the normal's derivative, which is unknown."""
        distance, normal = self.distances(points)
        return distance, normal, normal.new_zeros(*normal.shape, 3)


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
