"""Queries on a grid of signed distances: value and gradient."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class SignedDistanceGrid:
    """Signed distances to a surface, negative inside, sampled on a regular grid."""

    values: Float[Tensor, "nx ny nz"]
    """Distance at each grid point [m]."""
    gradient: Float[Tensor, "nx ny nz 3"]
    """Gradient of the distance at each grid point, about a unit vector."""
    origin: Float[Tensor, " 3"]
    """Position of the first grid point [m]."""
    spacing: float
    """Distance between neighbouring grid points [m]."""

    @staticmethod
    def from_values(
        values: Float[Tensor, "nx ny nz"], origin: Float[Tensor, " 3"], spacing: float
    ) -> SignedDistanceGrid:
        """A grid whose gradients are central differences of its values."""
        gradient = torch.stack(torch.gradient(values, spacing=spacing), -1)
        return SignedDistanceGrid(values, gradient, origin, spacing)

    def to(
        self, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> SignedDistanceGrid:
        """The same grid on another device or in another precision."""
        return SignedDistanceGrid(
            self.values.to(device=device, dtype=dtype), self.gradient.to(device=device, dtype=dtype),
            self.origin.to(device=device, dtype=dtype), self.spacing,
        )

    def query(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Signed distance [m] and its gradient, by the nearest grid point and first order.

        Outside the grid, the distance to the grid's box is added to the value at the nearest point of it,
        and the gradient points away from the box: never less than the true distance, and growing all the way.
        Autograd through the value gives the returned gradient.
        """
        size = torch.tensor(self.values.shape, device=points.device)
        scaled = (points - self.origin) / self.spacing
        clamped = torch.minimum(scaled.clamp(min=0), (size - 1).to(points.dtype))
        index = clamped.round().long()
        _, ny, nz = self.values.shape
        flat = (index[..., 0] * ny + index[..., 1]) * nz + index[..., 2]
        value = self.values.reshape(-1)[flat]
        gradient = self.gradient.reshape(-1, 3)[flat]
        step = (clamped - index) * self.spacing
        value = value + (gradient * step).sum(-1)
        outside = (scaled - clamped) * self.spacing
        beyond = outside.norm(dim=-1)
        away = outside / beyond.clamp(min=1e-9)[..., None]
        gradient = torch.where((beyond > 0)[..., None], away, gradient)
        return value + beyond, gradient
