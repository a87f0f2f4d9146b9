"""What grasps have to respect beside hand and object: where the palm points, what the hand stays clear of."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from dro_grasp.energy.surroundings import Surroundings
from dro_grasp.errors import OptionError
from dro_grasp.optimization.starts import Direction


@dataclass(frozen=True)
class Constraints:
    """What grasps have to respect; nothing by default. All in the object's frame."""

    direction: Direction | None = None
    """Palm direction; any by default. Over a table, palms tilt towards it as far as the hand needs room."""
    table: float | None = None
    """Height of a plane [m]; the hand stays above it, in pregrasp, grasp and squeeze."""

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

    def surroundings(self) -> Surroundings | None:
        """What the hand stays clear of; None for nothing."""
        if self.table is None:
            return None
        return Surroundings(torch.tensor([0.0, 0.0, 1.0, self.table]))
