"""Signed distances to a surface or to balls, with gradient, and of a surface normal and curvature, by one look-up per point."""

from __future__ import annotations

import operator
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

    @cached_property
    def _top(self) -> Float[Tensor, "3"]:
        """Place of the last voxel along each axis."""
        return self.origin.new_tensor(self.shape) - 1

    @cached_property
    def _strides(self) -> Float[Tensor, "3"]:
        """Rows between neighbours along each axis."""
        return self.origin.new_tensor([self.shape[1] * self.shape[2], self.shape[2], 1])

    def distances(self, points: Float[Tensor, "*b 3"]) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        """Signed distance [m] and its gradient: nearest voxel and first order; linear beyond the grid."""
        return _first_order(self.slopes, *self._locate(points))

    def normals(self, points: Float[Tensor, "*b 3"]) -> SurfaceModel:
        """Second-order model at the nearest voxel; each part is the exact derivative of the one before."""
        return _second_order(self.slopes, self.curvatures, *self._locate(points))

    def _locate(self, points: Float[Tensor, "*b 3"]) -> tuple[Int[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        """Row of the nearest voxel, and the offset from its centre [m]."""
        place = (points - self.origin) / self.spacing
        index = torch.minimum(place.round().clamp_min(0), self._top)
        offset = (place - index) * self.spacing
        return (index * self._strides).sum(-1).to(torch.int64), offset


class _Stack(NamedTuple):
    """Several fields, one after the other; as those of `DistanceFields`, with one row for each field."""

    fields: tuple[DistanceField, ...]
    slopes: Float[Tensor, "voxels 4"]
    curvatures: Float[Tensor, "voxels 9"]
    first: Int[Tensor, " o"]
    top: Float[Tensor, "o 3"]
    strides: Float[Tensor, "o 3"]
    origin: Float[Tensor, "o 3"]
    spacing: Float[Tensor, " o"]

    @staticmethod
    def of(fields: Sequence[DistanceField]) -> _Stack:
        """Stack fields of one device; the first keeps the stack, since stages in turn ask for the same."""
        kept = vars(fields[0]).get("_stack")
        if kept is not None and len(kept.fields) == len(fields) and all(map(operator.is_, kept.fields, fields)):
            return kept
        device, sizes = fields[0].slopes.device, torch.tensor([0] + [len(field.slopes) for field in fields])
        slopes, curvatures = (torch.cat([getattr(field, name) for field in fields]) for name in ("slopes", "curvatures"))
        top, strides, origin = (
            torch.stack([getattr(field, name) for field in fields]) for name in ("_top", "_strides", "origin"))
        spacing = torch.tensor([field.spacing for field in fields]).to(origin)
        made = _Stack(
            tuple(fields), slopes, curvatures, sizes.cumsum(0)[:-1].to(device), top, strides, origin, spacing)
        vars(fields[0])["_stack"] = made
        return made


@dataclass(frozen=True, eq=False)
class DistanceFields:
    """Fields of several objects, of which each row of points sees one."""

    slopes: Float[Tensor, "voxels 4"]  # of all fields, one after the other
    curvatures: Float[Tensor, "voxels 9"]
    first: Int[Tensor, " n"]  # first voxel of each row's field
    top: Float[Tensor, "n 3"]  # place of the last voxel along each axis
    strides: Float[Tensor, "n 3"]  # rows between neighbours along each axis
    origin: Float[Tensor, "n 3"]  # position of the first voxel [m]
    spacing: Float[Tensor, " n"]  # edge of a voxel [m]

    @staticmethod
    def of(fields: Sequence[DistanceField], counts: Sequence[int]) -> DistanceFields:
        """Fields of so many rows each; a field that comes twice is kept once."""
        own = list({id(field): field for field in fields}.values())
        place, stack = {id(field): k for k, field in enumerate(own)}, _Stack.of(own)
        which = torch.tensor([place[id(field)] for field in fields]).repeat_interleave(torch.tensor(counts))
        rows = (part[which.to(part.device)] for part in (stack.first, stack.top, stack.strides, stack.origin, stack.spacing))
        return DistanceFields(stack.slopes, stack.curvatures, *rows)

    def rows(self, index: slice | Int[Tensor, " k"]) -> DistanceFields:
        """The fields of some of the rows."""
        own = (getattr(self, name)[index] for name in ("first", "top", "strides", "origin", "spacing"))
        return DistanceFields(self.slopes, self.curvatures, *own)

    def distances(self, points: Float[Tensor, "n *b 3"]) -> tuple[Float[Tensor, "n *b"], Float[Tensor, "n *b 3"]]:
        """See `DistanceField.distances`."""
        return _first_order(self.slopes, *self._locate(points))

    def normals(self, points: Float[Tensor, "n *b 3"]) -> SurfaceModel:
        """See `DistanceField.normals`."""
        return _second_order(self.slopes, self.curvatures, *self._locate(points))

    def _locate(self, points: Float[Tensor, "n *b 3"]) -> tuple[Int[Tensor, "n *b"], Float[Tensor, "n *b 3"]]:
        """Row of the nearest voxel, and the offset from its centre [m]."""
        shape = (len(points), *[1] * (points.ndim - 2))
        origin, top, strides = (x.view(*shape, 3) for x in (self.origin, self.top, self.strides))
        spacing = self.spacing.view(*shape, 1)
        place = (points - origin) / spacing
        index = torch.minimum(place.round().clamp_min(0), top)
        offset = (place - index) * spacing
        return (index * strides).sum(-1).to(torch.int64) + self.first.view(shape), offset


def _first_order(
    slopes: Float[Tensor, "voxels 4"], row: Int[Tensor, "*b"], offset: Float[Tensor, "*b 3"]
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
    """Signed distance [m] and gradient at an offset from a voxel [m]."""
    near = slopes.index_select(0, row.flatten()).reshape(*row.shape, 4)
    gradient = near[..., 1:]
    return near[..., 0] + (gradient * offset).sum(-1), gradient


def _second_order(
    slopes: Float[Tensor, "voxels 4"], curvatures: Float[Tensor, "voxels 9"], row: Int[Tensor, "*b"],
    offset: Float[Tensor, "*b 3"],
) -> SurfaceModel:
    """The surface as a voxel knows it, at an offset from it [m]."""
    near, curvature = slopes[row], curvatures[row].unflatten(-1, (3, 3))
    gradient = near[..., 1:]
    turned = (curvature @ offset[..., None])[..., 0]
    distance = near[..., 0] + (gradient * offset).sum(-1) + 0.5 * (turned * offset).sum(-1)
    raw = gradient + turned
    length = raw.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    normal = raw / length
    tangent = curvature - normal[..., :, None] * (normal[..., None, :] @ curvature)
    return SurfaceModel(distance, raw, normal, tangent / length[..., None])


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
