"""The table in a cloud: a large plane with everything else on one side of it."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, QhullError

from dro_grasp.geometry.point_groups import separate_groups

NEAR = 0.006  # Points at most this far from a plane are counted for it [m] (ours)
WINDOW = 0.02  # Points at most this far from a plane tell how far its points scatter [m] (ours)
LEAST_THICK = 0.003  # Half thickness of a plane without noise [m] (ours): clouds are given to a millimetre
MOST_THICK = 0.02  # Largest half thickness of a plane [m] (ours); between, three standard deviations of what was seen
BELOW = 0.02  # Largest share of the points that may lie below a wide table; below a small one, of those above (ours)
WIDE = 0.08  # Area from which a plane is no wing or lid of an object of which parts stand on it [m^2] (ours)
LEAST_REST = 16  # Fewest points above a table (ours)


def table_plane(
    points: Float[np.ndarray, "n 3"], camera: Float[np.ndarray, "3"] | None = None
) -> Float[np.ndarray, "4"] | None:
    """Upward normal and height [m] of the table in a cloud [m], which the camera sees from above; None if there is none."""
    if len(points) < 2 * LEAST_REST or not np.abs(points).max() < 100.0:
        return None  # farther [m], it is in another unit (ours)
    plane = largest_plane(points, NEAR)
    if plane is None:
        return None
    height = points @ plane[:3] - plane[3]
    # Curved sides of things scatter as noise does: only a wide table may be thicker than NEAR.
    for thick in sorted({NEAR, max(NEAR, thickness(height))}):
        side = 1.0 if camera is None else math.copysign(1.0, float(camera @ plane[:3] - plane[3]))
        if camera is None and (height > thick).sum() < (height < -thick).sum():
            side = -1.0
        if _is_table(points, side * plane, side * height, thick, WIDE if thick > NEAR else 0.0):
            return side * plane
    return None


def _is_table(
    points: Float[np.ndarray, "n 3"], plane: Float[np.ndarray, "4"], height: Float[np.ndarray, " n"], thick: float,
    least: float,
) -> bool:
    """Whether a plane of at least this area [m^2] is a table, and everything else is above it."""
    on, above, below = np.abs(height) <= thick, height > thick, height < -thick
    # The shares and the area are ours. A table is twice as large as what stands on it: an object's flat face is none.
    if on.mean() < 0.3 or above.sum() < LEAST_REST or below.mean() > BELOW:
        return False
    area, standing = _area(points[on], plane), _area(points[above], plane)
    if area > WIDE:  # several things, or scattered points, may stand all over it
        standing = sum(_area(points[above][own], plane) for own in separate_groups(points[above]))
    elif below.sum() > BELOW * above.sum():
        return False
    return area > max(least, 2.0 * standing)


def above_plane(points: Float[np.ndarray, "n 3"], plane: Float[np.ndarray, "4"]) -> Bool[np.ndarray, " n"]:
    """Points above the plane by more than it is thick."""
    height = points @ plane[:3] - plane[3]
    return np.asarray(height > thickness(height))


def scatter(height: Float[np.ndarray, " n"]) -> float:
    """Standard deviation of the heights of a plane's points [m], by the median of those near it; 0 for none."""
    near = np.abs(height[np.abs(height) < WINDOW])
    return 1.4826 * float(np.median(near)) if len(near) else 0.0


def thickness(height: Float[np.ndarray, " n"]) -> float:
    """Half thickness of a plane whose points have such heights among others [m]: three standard deviations."""
    return float(np.clip(3 * scatter(height), LEAST_THICK, MOST_THICK))


def moved_plane(plane: Float[np.ndarray, "4"], T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4"]:
    """The same plane in another frame, of which `T` is the pose of the old one: unit normal, and height along it [m]."""
    normal = T[:3, :3] @ plane[:3]
    return np.append(normal, plane[3] + normal @ T[:3, 3])


def largest_plane(
    points: Float[np.ndarray, "n 3"], near: float, steepest: float = math.pi / 2, fits: int = 1
) -> Float[np.ndarray, "4"] | None:
    """Upward unit normal of the plane with most points near it, and its height along the normal [m]; None if there is none.

    Points at most `near` from a plane are counted [m], and `steepest` is the largest angle of its normal to the z axis [rad].
    Each of some least-squares `fits` takes the points near the one before. Source: RANSAC, Fischler and Bolles 1981.
    """
    if len(points) < 3:
        return None
    rng = np.random.default_rng(0)
    # Of 300 planes through three random points, all miss a third of the points once in 80,000 times (ours).
    some = points[rng.permutation(len(points))[:4000]]
    a, b, c = some[rng.integers(len(some), size=(3, 300))]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    kept = (length > 0) & (np.abs(normal[:, 2]) >= math.cos(steepest) * length)
    if not kept.any():
        return None
    a, normal = a[kept], normal[kept] / length[kept, None]
    heights = (a * normal).sum(1)
    best = (np.abs(some @ normal.T - heights) <= near).sum(0).argmax()
    plane = np.append(normal[best], heights[best])
    for _ in range(fits):
        own = points[np.abs(points @ plane[:3] - plane[3]) <= near]
        middle = own.mean(0)
        across = np.linalg.eigh((own - middle).T @ (own - middle))[1][:, 0]
        across = across * np.copysign(1.0, across[2])
        plane = np.append(across, across @ middle)
    return plane


def _area(points: Float[np.ndarray, "n 3"], plane: Float[np.ndarray, "4"]) -> float:
    """Area of the convex hull of points seen along the normal [m^2]."""
    across = np.linalg.svd(plane[None, :3])[2][1:]
    try:
        return float(ConvexHull(points @ across.T).volume)
    except QhullError:
        return 0.0
