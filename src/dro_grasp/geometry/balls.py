"""Balls: a place that is to be held, or one that is to be left alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.geometry.point_clouds import point_distances

Ball = tuple[float, float, float, float]
"""Centre and radius [m]."""


@dataclass(frozen=True, eq=False)
class Balls:
    """The union of balls, with signed distances as of a `DistanceField`."""

    centres: Float[Tensor, "k 3"]
    """[m]"""
    radii: Float[Tensor, " k"]
    """[m]"""

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
