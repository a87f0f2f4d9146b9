"""The palm of a hand and the direction it faces, derived from geometry alone.

The half-closed hand encloses a volume. An object would sit in the largest ball that palm and fingers surround there: its
centre is the grasp centre, and the palm direction points from the palm's surface to it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, KDTree, QhullError

from dro_grasp.errors import HandError

GRID_SPACING = 0.008
"""Spacing of candidate ball centres [m] (ours)."""
PLANES = 32
"""Planes of the hull that the centres are compared with at once; most centres fall to the first (ours)."""
CLOSINGS = (0.35, 0.5, 0.65)
"""Shares of the way from open to closed at which the hand is examined (ours)."""
EARLY_CLOSINGS = (0.1, 0.2, *CLOSINGS)
"""Shares of the way from open to closed at which hands whose fingers may roll up are examined as well (ours)."""
WELL_ENCLOSED = 0.04
"""Score of a palm above which no earlier closing is looked at [m] (ours)."""
MUCH_BETTER = 0.01
"""How much better a palm must be for that it is found at an earlier closing [m] (ours). Grippers with such limits gain 0.014 to
0.02, D'Claw 0.003."""
FACE_POINTS = 16
"""Number of palm samples nearest to the grasp centre that make up the palm's inner face (ours)."""
NOTHING_ENCLOSED = ("palm and fingers of the half-closed hand enclose no space, so nothing can be grasped; check the origins, "
                    "axes and limits of its joints")
"""Error message for a hand that encloses nothing."""
LARGEST_BALL = 0.05
"""Radius beyond which a larger empty ball is no better [m] (ours)."""


@dataclass(frozen=True)
class Palm:
    """The palm in some frame."""

    centre: Float[np.ndarray, "3"]
    """Middle of the inner face [m]."""
    direction: Float[np.ndarray, "3"]
    """Unit vector towards the object."""
    grasp_centre: Float[np.ndarray, "3"]
    """Centre of the enclosed ball [m]."""
    score: float
    """How well palm and fingers surround the ball [m]; higher is better."""


def find_palm(
    palm_points: Float[np.ndarray, "n 3"], palm_normals: Float[np.ndarray, "n 3"], fingers: list[Float[np.ndarray, "_ 3"]]
) -> Palm:
    """The palm in front of which palm and fingers enclose a ball best.

    Args:
        palm_points: Surface of the palm [m].
        palm_normals: Outward normals there.
        fingers: Surface points of each finger [m].

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
    for some in np.array_split(planes, math.ceil(len(planes) / PLANES)):
        grid = grid[(grid @ some[:, :3].T < -some[:, 3]).all(1)]
    tree = KDTree(palm_points)
    to_palm, nearest = map(np.asarray, tree.query(grid))
    outside = ((grid - palm_points[nearest]) * palm_normals[nearest]).sum(1) > 0.7 * to_palm
    grid, to_palm, nearest = grid[outside], to_palm[outside], nearest[outside]
    if not len(grid):
        raise HandError(NOTHING_ENCLOSED)
    to_fingers = np.stack([KDTree(f).query(grid)[0] for f in fingers], 1)
    radius = np.minimum(np.minimum(to_palm, to_fingers.min(1)), LARGEST_BALL)
    # A ball that touches everything around it scores its radius; gaps to palm and fingers count against it.
    gaps = (to_palm - radius + (to_fingers - radius[:, None]).mean(1)) / 2
    score = radius - 0.5 * gaps
    best = score > score.max() - 0.002
    centre = grid[best].mean(0)
    return Palm(*_face_towards(palm_points, palm_normals, centre), centre, float(score.max()))


def _face_towards(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Middle [m] and mean normal of the part of the palm's surface that is nearest to a point in front of it."""
    offset = target - points
    distance = np.linalg.norm(offset, axis=1)
    facing = (offset * normals).sum(1) > 0.5 * distance
    facing = facing if facing.any() else np.ones(len(points), bool)
    nearest = np.flatnonzero(facing)[np.argsort(distance[facing])[:FACE_POINTS]]
    normal = normals[nearest].mean(0)
    return points[nearest].mean(0), normal / np.linalg.norm(normal)
