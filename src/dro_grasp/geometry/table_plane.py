"""The table in a cloud: a large plane with everything else on one side of it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, QhullError

THICKNESS = 0.006
"""Points nearer than this to the plane belong to it [m] (ours): about three standard deviations of a depth camera's noise."""
LEAST_SHARE = 0.3
"""Least share of a cloud's points on its table (ours)."""
LARGEST_BELOW = 0.02
"""Largest share of the other points on the far side of a table (ours)."""
LEAST_AREA = 2.0
"""Least area of a table, as a multiple of the area that everything on it covers (ours): an object's flat face is no table."""
TRIALS = 200
"""Planes through three random points that are tried (ours); a third of the points is missed by all once in a thousand times."""
FARTHEST = 100.0
"""A cloud with a larger coordinate is in another unit, and no table is looked for [m] (ours)."""
LEAST_REST = 16
"""Fewest points above a table (ours)."""


def table_plane(
    points: Float[np.ndarray, "n 3"], camera: Float[np.ndarray, "3"] | None = None
) -> Float[np.ndarray, "4"] | None:
    """Upward unit normal of the table in a cloud, and its height along the normal [m]; None if no plane looks like one.

    Args:
        points: The cloud [m].
        camera: Where it was seen from; a table is seen from above.
    """
    if len(points) < 2 * LEAST_REST or not np.abs(points).max() < FARTHEST:
        return None
    plane = _largest_plane(points)
    if plane is None:
        return None
    height = points @ plane[:3] - plane[3]
    if camera is not None and camera @ plane[:3] < plane[3]:
        plane, height = -plane, -height
    elif camera is None and (height > THICKNESS).sum() < (height < -THICKNESS).sum():
        plane, height = -plane, -height
    on, above, below = np.abs(height) <= THICKNESS, height > THICKNESS, height < -THICKNESS
    if on.mean() < LEAST_SHARE or above.sum() < LEAST_REST or below.sum() > LARGEST_BELOW * above.sum():
        return None
    return plane if _area(points[on], plane) > LEAST_AREA * _area(points[above], plane) else None


def above_plane(points: Float[np.ndarray, "n 3"], plane: Float[np.ndarray, "4"]) -> Bool[np.ndarray, " n"]:
    """Points above the plane by more than its thickness."""
    return points @ plane[:3] - plane[3] > THICKNESS


def _largest_plane(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "4"] | None:
    """The plane with most points near it, by random sampling and a fit to them. Source: Fischler and Bolles 1981 (RANSAC)."""
    rng = np.random.default_rng(0)
    some = points[rng.permutation(len(points))[:2000]]
    a, b, c = some[rng.integers(len(some), size=(3, TRIALS))]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    a, normal = a[length > 0], normal[length > 0] / length[length > 0, None]
    if not len(a):
        return None
    near = np.abs(some @ normal.T - (a * normal).sum(1)) <= THICKNESS
    best = some[near[:, near.sum(0).argmax()]]
    middle = best.mean(0)
    up = np.linalg.svd(best - middle, full_matrices=False)[2][2]
    return np.append(up, up @ middle)


def _area(points: Float[np.ndarray, "n 3"], plane: Float[np.ndarray, "4"]) -> float:
    """Area of the convex hull of points seen along the normal [m^2]."""
    across = np.linalg.svd(plane[None, :3])[2][1:]
    try:
        return float(ConvexHull(points @ across.T).volume)
    except QhullError:
        return 0.0
