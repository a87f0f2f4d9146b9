"""How a built-in object is stated: what it is made of, its mass, and the split that it is in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from dro_grasp.objects.shape import DENSITY, ObjectModel
from dro_grasp.objects.solids import Pieces, assemble

HARD_TRAIN = "hard_train"
"""Split of the hard objects that development may look at."""
HARD_TEST = "hard_test"
"""Split of the hard objects by which nothing is ever chosen."""
STEEL = 7850.0  # Density [kg/m^3]; this and the next are the usual values of tables of materials
IRON = 7200.0  # Density of cast iron [kg/m^3]
BRASS = 8500.0  # Density [kg/m^3]
PORCELAIN = 2400.0  # Density [kg/m^3]
ACRYLIC = 1180.0  # Density [kg/m^3]


@dataclass(frozen=True)
class BuiltinObject:
    """How a built-in object is made."""

    make: Callable[[], Pieces]
    split: str
    """`train`, `test`, `hard_train` or `hard_test`."""
    mass: float | None = None
    """Mass [kg]; None takes the density."""
    density: float = DENSITY
    """[kg/m^3]"""

    def build(self, name: str, scale: float = 1.0) -> ObjectModel:
        """The object; `scale` multiplies all coordinates, and the density stays."""
        return assemble(name, self.make(), scale=scale, split=self.split, mass=self.mass, density=self.density)
