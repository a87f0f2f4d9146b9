"""Signed distances to a surface or to balls, with gradient, and of a surface normal and curvature, by one look-up per point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from dro_grasp.geometry.point_clouds import point_distances

Ball = tuple[float, float, float, float]  # Centre and radius [m]
BLUR = (0.25, 0.5, 0.25)
"""Binomial weights that smooth the gradient field along each axis [1] (ours): edges of voxels are not edges of the object."""


class SurfaceModel(NamedTuple):
    """Second-order model of a surface at some points."""

    distance: Float[Tensor, "*b"]  # signed distance [m]
    gradient: Float[Tensor, "*b 3"]  # gradient of the distance, about a unit vector
    normal: Float[Tensor, "*b 3"]  # outward unit normal: the direction of the gradient
    bend: Float[Tensor, "*b 3 3"]  # derivative of the normal by position [1/m]


@dataclass(frozen=True, eq=False)
class DistanceField:
    """Signed distances to a surface, negative inside: a second-order model around every voxel of a grid.

    Voxels lie in one row, the last axis fastest, so that a point costs one look-up.
    """

    slopes: Float[Tensor, "voxels 4"]  # per voxel: distance [m] and unit gradient
    shape: tuple[int, int, int]  # voxels per axis
    origin: Float[Tensor, "3"]  # position of the first voxel [m]
    spacing: float  # edge of a voxel [m]

    @staticmethod
    def from_values(values: Float[Tensor, "nx ny nz"], origin: Float[Tensor, "3"], spacing: float) -> DistanceField:
        """Derive the gradients from a grid of signed distances [m]; the precision is that of the values."""
        gradient = _differences(_smooth(values), spacing)
        gradient = gradient / gradient.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        slopes = torch.cat([values[..., None], gradient], -1).flatten(0, 2)
        nx, ny, nz = values.shape
        return DistanceField(slopes, (nx, ny, nz), origin.to(values), spacing)

    @cached_property
    def curvatures(self) -> Float[Tensor, "voxels 9"]:
        """Per voxel: symmetric derivative of the gradient [1/m]; zero at the border, beyond which the field is linear."""
        gradient = self.slopes[:, 1:].unflatten(0, self.shape)
        curvature = torch.stack([_differences(gradient[..., k], self.spacing) for k in range(3)], -2)
        curvature = (0.5 * (curvature + curvature.mT)).clamp(-0.5 / self.spacing, 0.5 / self.spacing)
        for axis in range(3):
            for end in (0, -1):
                curvature.select(axis, end).zero_()
        return curvature.flatten(-2).flatten(0, 2).contiguous()

    def distances(self, points: Float[Tensor, "*b 3"]) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        """Signed distance [m] and its gradient: nearest voxel and first order; linear beyond the grid."""
        row, offset = self._locate(points)
        near = self.slopes.index_select(0, row.flatten()).reshape(*points.shape[:-1], 4)
        gradient = near[..., 1:]
        return near[..., 0] + (gradient * offset).sum(-1), gradient

    def normals(self, points: Float[Tensor, "*b 3"]) -> SurfaceModel:
        """Second-order model at the nearest voxel; each part is the exact derivative of the one before."""
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

    def _locate(self, points: Float[Tensor, "*b 3"]) -> tuple[Int[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        """Row of the nearest voxel, and the offset from its centre [m]."""
        place = (points - self.origin) / self.spacing
        top = place.new_tensor(self.shape) - 1
        index = torch.minimum(place.round().clamp_min(0), top)
        offset = (place - index) * self.spacing
        strides = place.new_tensor([self.shape[1] * self.shape[2], self.shape[2], 1])
        return (index @ strides).to(torch.int64), offset


@dataclass(frozen=True, eq=False)
class Balls:
    """The union of balls, with signed distances as of a `DistanceField`."""

    centres: Float[Tensor, "k 3"]  # [m]
    radii: Float[Tensor, " k"]  # [m]

    @staticmethod
    def of(balls: Sequence[Ball]) -> Balls | None:
        """From centres and radii; None for none."""
        values = torch.tensor(balls, dtype=torch.float32)
        return Balls(values[:, :3], values[:, 3]) if len(balls) else None

    def distances(self, points: Float[Tensor, "*b 3"]) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        """Distance to the surface of the nearest ball, negative inside [m], and its gradient."""
        apart = point_distances(points, self.centres.to(points))
        distance, index = (apart - self.radii.to(points)).min(-1)
        offset = points - self.centres.to(points)[index]
        return distance, torch.nn.functional.normalize(offset, dim=-1)


def _smooth(values: Float[Tensor, "x y z"]) -> Float[Tensor, "x y z"]:
    """Blur along each axis; the border repeats itself."""
    kernel = values.new_tensor(BLUR)
    result = values[None, None]
    for axis in range(3):
        shape = [1, 1, 1, 1, 1]
        shape[2 + axis] = 3
        pad = [0, 0, 0, 0, 0, 0]  # pairs of widths, the last axis first
        pad[2 * (2 - axis)] = pad[2 * (2 - axis) + 1] = 1
        result = F.conv3d(F.pad(result, pad, mode="replicate"), kernel.reshape(shape))
    return result[0, 0]


def _differences(values: Float[Tensor, "x y z"], spacing: float) -> Float[Tensor, "x y z 3"]:
    """Gradient by central differences, one-sided at the border."""
    return torch.stack(torch.gradient(values, spacing=spacing), -1)
