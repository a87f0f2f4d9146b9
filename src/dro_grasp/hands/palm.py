"""Where a hand's palm is and where it looks: derived from geometry alone.

The half-closed hand encloses a volume. The largest ball in it that palm and fingers surround is where an object
would sit; its centre is the grasp centre, and the palm direction points from the palm's surface to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from dro_grasp.errors import HandError

GRID_SPACING = 0.008
"""Spacing of candidate ball centres [m]."""
CLOSINGS = (0.35, 0.5, 0.65)
"""Shares of the way from open to closed at which the hand is examined."""
FACE_POINTS = 16
"""Palm samples nearest to the grasp centre that make up its inner face."""
NOTHING_ENCLOSED = ("palm and fingers of the half-closed hand enclose no space, so nothing can be grasped; check the origins, "
                    "axes and limits of its joints")
"""What a hand without a grasp is told."""
LARGEST_BALL = 0.05
"""Radius beyond which a larger empty ball is no better [m]."""


@dataclass(frozen=True)
class Palm:
    """The palm in some frame."""

    centre: np.ndarray
    """Middle of the inner face (3) [m]."""
    direction: np.ndarray
    """Unit vector towards the object (3)."""
    grasp_centre: np.ndarray
    """Centre of the enclosed ball (3) [m]."""
    score: float
    """How well palm and fingers surround the ball [m]; higher is better."""


def find_palm(palm_points: np.ndarray, palm_normals: np.ndarray, fingers: list[np.ndarray]) -> Palm:
    """The ball that palm and fingers enclose best.

    Args:
        palm_points: Surface of the palm (n 3) [m].
        palm_normals: Outward normals there (n 3).
        fingers: Surface points of each finger, distal links (n_i 3 each).

    Raises:
        HandError: They enclose nothing.
    """
    everything = np.concatenate([palm_points, *fingers])
    try:
        hull = ConvexHull(everything)
    except QhullError as error:
        raise HandError(NOTHING_ENCLOSED) from error
    low, high = everything.min(0), everything.max(0)
    axes = [np.arange(a, b, GRID_SPACING) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    planes = np.unique(hull.equations.round(6), axis=0)
    for plane in planes:
        grid = grid[grid @ plane[:3] < -plane[3]]
    tree = cKDTree(palm_points)
    to_palm, nearest = tree.query(grid)
    outside = ((grid - palm_points[nearest]) * palm_normals[nearest]).sum(1) > 0.7 * to_palm
    grid, to_palm, nearest = grid[outside], to_palm[outside], nearest[outside]
    if not len(grid):
        raise HandError(NOTHING_ENCLOSED)
    to_fingers = np.stack([cKDTree(f).query(grid)[0] for f in fingers], 1)
    radius = np.minimum(np.minimum(to_palm, to_fingers.min(1)), LARGEST_BALL)
    # A ball that touches everything around it scores its radius; gaps to palm and fingers count against it.
    gaps = (to_palm - radius + (to_fingers - radius[:, None]).mean(1)) / 2
    score = radius - 0.5 * gaps
    best = score > score.max() - 0.002
    centre = grid[best].mean(0)
    return Palm(*_face_towards(palm_points, palm_normals, centre), centre, float(score.max()))


def _face_towards(points: np.ndarray, normals: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middle and mean normal of the palm's surface nearest to a point in front of it."""
    offset = target - points
    distance = np.linalg.norm(offset, axis=1)
    facing = (offset * normals).sum(1) > 0.5 * distance
    facing = facing if facing.any() else np.ones(len(points), bool)
    nearest = np.flatnonzero(facing)[np.argsort(distance[facing])[:FACE_POINTS]]
    normal = normals[nearest].mean(0)
    return points[nearest].mean(0), normal / np.linalg.norm(normal)
