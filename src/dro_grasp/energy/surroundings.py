"""What a hand must stay clear of beside the object: all below a plane, obstacles, and places that are to be left alone."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.devices import on_device
from dro_grasp.geometry.distance_field import Balls, DistanceField


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Signed distances to whatever is nearest, negative inside."""

    plane: Float[Tensor, "4"] | None = None
    """Upward unit normal of a plane, and its height along the normal [m]."""
    obstacles: DistanceField | None = None
    """Signed distances of other things."""
    spared: Balls | None = None
    """Places where the hand is not wanted."""

    @property
    def up(self) -> Float[Tensor, "3"] | None:
        """Normal of the plane."""
        return None if self.plane is None else self.plane[:3]

    @property
    def parts(self) -> dict[str, Surroundings]:
        """The same one by one: plane, obstacles, spared."""
        return {name: Surroundings(**{name: part}) for name in ("plane", "obstacles", "spared")
                if (part := getattr(self, name)) is not None}

    def distances(self, points: Float[Tensor, "*b 3"]) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        """Signed distance [m] and its gradient, as of a `DistanceField`."""
        distance, gradient = torch.full_like(points[..., 0], torch.inf), torch.zeros_like(points)
        if self.plane is not None:
            distance, gradient = points @ self.plane[:3] - self.plane[3], self.plane[:3].expand_as(points)
        for part in (self.obstacles, self.spared):
            if part is not None:
                other, slope = part.distances(points)
                nearer = other < distance
                distance = torch.where(nearer, other, distance)
                gradient = torch.where(nearer[..., None], slope, gradient)
        return distance, gradient

    def lift(self, points: Float[Tensor, "*b p 3"], clear: float) -> Float[Tensor, "*b 3"]:
        """The shift up the plane's normal that brings points this far above it [m]; none where they are already."""
        if self.plane is None:
            return torch.zeros_like(points[..., 0, :])
        lowest = (points @ self.plane[:3]).amin(-1) - self.plane[3]
        return (clear - lowest).clamp_min(0)[..., None] * self.plane[:3]

    def to(self, device: torch.device | str) -> Surroundings:
        """The same on another device."""
        plane = None if self.plane is None else self.plane.to(device)
        obstacles = None if self.obstacles is None else on_device(self.obstacles, device)
        return Surroundings(plane, obstacles, None if self.spared is None else on_device(self.spared, device))
