"""The six half-axes of a frame as names, directions and bins of directions."""

from __future__ import annotations

from jaxtyping import Float, Int
from torch import Tensor

HALF_AXES = ("+x", "-x", "+y", "-y", "+z", "-z")
"""Names of the half-axes, in the order of the indices of `half_axis`."""


def half_axis(directions: Float[Tensor, "n 3"]) -> Int[Tensor, " n"]:
    """Index into HALF_AXES of the half-axis nearest to each direction."""
    axis = directions.abs().argmax(-1)
    return 2 * axis + (directions.gather(1, axis[:, None])[:, 0] < 0)


def half_axis_direction(name: str) -> tuple[float, float, float]:
    """The unit vector along one of HALF_AXES."""
    sign = 1.0 if name[0] == "+" else -1.0
    x, y, z = (sign if letter == name[1] else 0.0 for letter in "xyz")
    return x, y, z
