"""Whether and how an object, as it collides, rests on a table."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float

from dro_grasp.objects.shape import ObjectModel

RESTS = 0.003  # Gap up to which an object counts as lying on a table [m]. Ours


def lowest_points(obj: ObjectModel, up: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """How far the lowest point of an object, as it collides, is along each upward direction [m]."""
    if obj.balls is not None:
        return (up @ obj.balls.centres.double().numpy().T - obj.balls.radii.double().numpy()).min(1)
    return (up @ np.concatenate([vertices for vertices, _ in obj.parts]).T).min(1)


def stands(obj: ObjectModel, up: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Whether an estimated object stands on its lowest points, for each upward direction; what is known may fall over.

    A camera sees things at rest. Where the estimate of one has its lowest points to one side, that is an error of the estimate.
    """
    if obj.balls is None:
        return np.ones(len(up), bool)
    centres, radii = obj.balls.centres.double().numpy(), obj.balls.radii.double().numpy()
    heights = up @ centres.T - radii
    low = heights < heights.min(1, keepdims=True) + RESTS
    # The centre of mass is above the hull of what carries it if no half of the directions around it is empty.
    across = np.linalg.svd(up[:, None])[2][:, 1:]
    x, y = np.einsum("nsk,bk->snb", across, centres - obj.centre_of_mass)
    angles = np.where(low, np.arctan2(y, x), np.nan)
    angles = np.sort(np.where(low, angles, np.nanmax(angles, 1, keepdims=True)), 1)
    gaps = np.diff(angles, axis=1, append=angles[:, :1] + 2 * math.pi)
    return gaps.max(1) < math.pi
