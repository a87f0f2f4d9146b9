"""The palm of a hand and the direction it faces, derived from geometry alone.

The half-closed hand encloses a volume. An object would sit in the largest ball that palm and fingers surround there: its
centre is the grasp centre, and the palm direction points from the palm's surface to it.

Where one jaw moves, as in many small grippers, the palm's link is both the block between the jaws and the jaw that stands
still. Only with the two told apart is the palm direction the one in which the jaws point.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, KDTree, QhullError

from dro_grasp.errors import HandError
from dro_grasp.hands.anatomy import PALM
from dro_grasp.hands.hand import Hand

Point = Float[np.ndarray, "3"]
Points = Float[np.ndarray, "n 3"]
Mask = Bool[np.ndarray, " n"]
GRID_SPACING = 0.008  # Spacing of candidate ball centres [m] (ours)
CLOSINGS = (0.35, 0.5, 0.65)  # Shares of the way from open to closed at which the hand is examined (ours)
EARLY_CLOSINGS = (0.1, 0.2, *CLOSINGS)
"""Shares of the way from open to closed at which hands whose fingers may roll up are examined as well (ours)."""
WELL_ENCLOSED = 0.04  # Score of a palm above which no earlier closing is looked at [m] (ours)
MUCH_BETTER = 0.01
"""How much better a palm must be for that it is found at an earlier closing [m] (ours). Grippers with such limits gain 0.014 to
0.02, D'Claw 0.003."""
FACE_POINTS = 16  # Number of palm samples nearest to the grasp centre that make up the palm's inner face (ours)
NOTHING_ENCLOSED = ("palm and fingers of the half-closed hand enclose no space, so nothing can be grasped; check the origins, "
                    "axes and limits of its joints")
"""Error message."""
LARGEST_BALL = 0.05  # Radius beyond which a larger empty ball is no better [m] (ours)
NEARLY_CLOSED = (0.79, 0.8)
"""Shares of the way from open to closed between which the jaw is looked for (ours). Closed all the way, jaws often overlap."""
SLIDING = 0.1  # Difference in speed along a finger, as a share of its mean, below which it slides rather than turns (ours)
KNUCKLE = 0.25  # Share of the finger beside which the jaw has not begun (ours)
LEAST_LENGTH = 0.3  # Length of a jaw, as a share of the finger's, below which the palm has none (ours)
LARGEST_WIDTH = 2.5  # Width of a jaw, as a multiple of the finger's, above which it is a flat palm (ours)


@dataclass(frozen=True)
class Palm:
    """The palm in some frame."""

    centre: Point  # middle of the inner face [m]
    direction: Point  # unit vector towards the object
    grasp_centre: Point  # centre of the enclosed ball [m]
    score: float  # how well palm and fingers surround the ball [m]; higher is better


def find_palm(palm_points: Points, palm_normals: Points, fingers: list[Float[np.ndarray, "_ 3"]]) -> Palm:
    """The palm in front of which palm and fingers, given by surface points [m] and outward normals, enclose a ball best.

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
    for some in np.array_split(planes, math.ceil(len(planes) / 32)):  # most centres fall to the first planes
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


def _face_towards(points: Points, normals: Points, target: Point) -> tuple[Point, Point]:
    """Middle [m] and mean normal of the part of the palm's surface that is nearest to a point in front of it."""
    offset = target - points
    distance = np.linalg.norm(offset, axis=1)
    facing = (offset * normals).sum(1) > 0.5 * distance
    facing = facing if facing.any() else np.ones(len(points), bool)
    nearest = np.flatnonzero(facing)[np.argsort(distance[facing])[:FACE_POINTS]]
    normal = normals[nearest].mean(0)
    return points[nearest].mean(0), normal / np.linalg.norm(normal)


@dataclass(frozen=True)
class FixedJaw:
    """The part of a palm that a finger closes on."""

    mask: Mask  # the points of the hand that are on it
    direction: Point  # unit vector from the palm to its end, along the nearly closed finger
    length: float  # how far it extends from there [m]


def find_fixed_jaw(before: Points, points: Points, on_palm: Mask, on_finger: Mask) -> FixedJaw | None:
    """The jaw that a nearly closed finger approaches; None if the palm has no such part, as a flat palm or a block alone.

    Along the finger, the jaw begins where the part of the palm ends that the closing finger has passed.

    Args:
        before: Surface points of the hand a little before [m].
        points: The same points when it is nearly closed [m].
    """
    if not on_palm.any() or (on_palm & on_finger).any():
        return None
    palm, finger, motion = points[on_palm], points[on_finger], (points - before)[on_finger]
    if not (closing := _unit(motion.mean(0))).any():
        return None
    outwards = _faster(finger, np.linalg.norm(motion, axis=1))
    outwards = finger.mean(0) - palm.mean(0) if outwards is None else outwards
    outwards = _unit(outwards - (outwards @ closing) * closing)
    across = np.cross(outwards, closing)
    along_palm, along_finger = palm @ outwards, finger @ outwards
    outer_half = finger[along_finger > along_finger.mean()]
    passed = palm @ closing < outer_half.mean(0) @ closing
    begin = along_palm[passed].max(initial=along_finger.min() + KNUCKLE * np.ptp(along_finger))
    length, mask = float(along_palm.max() - begin), on_palm & (points @ outwards > begin)
    if length < LEAST_LENGTH * np.ptp(along_finger) or np.array_equal(mask, on_palm):
        return None
    flat = np.ptp(points[mask] @ across) > LARGEST_WIDTH * np.ptp(finger @ across)
    return None if flat else FixedJaw(mask, outwards, length)


def fixed_jaw_of(hand: Hand) -> FixedJaw | None:
    """The part of the palm that a hand's single finger closes on; None of several fingers."""
    if len(hand.fingers) > 1:
        return None
    before, after = (hand.points(hand.canonical_joints(1 - share)).numpy() for share in NEARLY_CLOSED)
    return find_fixed_jaw(before, after, *((hand.finger_of_link[hand.link_index] == part).numpy() for part in (PALM, 0)))


def _faster(points: Float[np.ndarray, "m 3"], speed: Float[np.ndarray, " m"]) -> Point | None:
    """The direction in which points move faster, from the hinge outwards; None if all move alike."""
    offset = points - points.mean(0)
    gradient = np.linalg.lstsq(offset, speed - speed.mean())[0]
    return gradient if np.ptp(offset @ gradient) > SLIDING * speed.mean() else None


def _unit(vector: Point) -> Point:
    """The vector's direction; zero if it has none."""
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
