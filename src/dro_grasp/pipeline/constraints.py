"""What grasps have to respect beside hand and object: where the palm points, what the hand stays clear of."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from dro_grasp.energy.surroundings import Surroundings
from dro_grasp.errors import OptionError
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimization.starts import Direction

ELSEWHERE = 0.01
"""A table farther than this from the one in the cloud is another [m] (ours)."""
UPRIGHT = math.cos(math.radians(5.0))
"""Least cosine between z and the normal of a table whose height along z is given (ours)."""
SIDEWAYS = 0.1
"""Least such cosine of a plane that has a height at all (ours)."""


@dataclass(frozen=True)
class Constraints:
    """What grasps have to respect; nothing by default. All in the object's frame."""

    direction: Direction | None = None
    """Palm direction; any by default. Over a table, palms tilt towards it as far as the hand needs room."""
    table: float | None = None
    """Height of a plane [m]; the hand stays above it, in pregrasp, grasp and squeeze. By default the table that was found in a
    cloud, if any."""

    def __post_init__(self) -> None:
        """Refuse what cannot be done, before any work.

        Raises:
            OptionError: A number is out of range, or the direction is zero.
        """
        if self.direction is not None and not 1e-9 <= math.hypot(*self.direction) < math.inf:
            raise OptionError(f"direction {self.direction} has no direction; give the palm direction in the object's frame, "
                              "for example --direction 0 0 -1 to grasp from above")
        if self.table is not None and not math.isfinite(self.table):
            raise OptionError(f"table is {self.table}; give the height in metres, for example --table 0")

    def doubt(self, obj: ObjectModel) -> str | None:
        """What is odd about the table, in words; None for nothing."""
        if self.table is None or obj.table is None:
            return None
        found, centre = torch.tensor(obj.table), torch.tensor(obj.centre_of_mass)
        height = float((found[3] - found[:2] @ centre[:2]) / found[2]) if abs(float(found[2])) > SIDEWAYS else math.inf
        if abs(height - self.table) < ELSEWHERE and float(found[2]) > UPRIGHT:
            return None
        x, y, z, distance = (f"{float(value):.3g}" for value in obj.table)
        return (f"table is z = {self.table:g} m, but the table in the cloud is where {x} x + {y} y + {z} z = {distance} "
                "m. Leave out table, which takes the one in the cloud; or, if the cloud is a camera's, give the camera's pose")

    def surroundings(self, obj: ObjectModel) -> Surroundings | None:
        """What the hand stays clear of around an object; None for nothing."""
        plane = obj.table if self.table is None else (0.0, 0.0, 1.0, self.table)
        return None if plane is None else Surroundings(torch.tensor(plane, dtype=torch.float32))
