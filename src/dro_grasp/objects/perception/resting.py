"""What rests on a plane touches it, and ends there."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

RESTS = 0.002  # What ends no higher above the plane stands on it [m] (ours)
HOLLOW = 0.35  # What ends higher than this share of its height above it is not known well enough to be made longer (ours)


def set_down(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], added: Bool[np.ndarray, " n"],
    table: Float[np.ndarray, "4"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Points [m] and unit normals with an underside that reaches the plane below: what rests on a plane touches it.

    From above, the underside of a lying thing is not seen, and is completed too high. The added points of the lower half are
    moved down, in proportion to their depth; what was seen stays where it is.
    """
    up = table[:3] / np.linalg.norm(table[:3])
    height = (points @ table[:3] - table[3]) / np.linalg.norm(table[:3])
    gap, middle = float(height.min()), float(height.max()) / 2
    if not RESTS < gap < HOLLOW * 2 * middle:
        return points, normals
    low, stretch = added & (height < middle), middle / (middle - gap)
    down = np.where(low, (stretch - 1) * (middle - height), 0.0)
    # A surface that is stretched along one axis has normals that shrink along it.
    turned = normals + np.where(low, (1 / stretch - 1) * (normals @ up), 0.0)[:, None] * up
    return points - down[:, None] * up, turned / np.linalg.norm(turned, axis=1, keepdims=True)
