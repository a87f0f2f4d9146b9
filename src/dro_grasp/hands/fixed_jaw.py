"""The fixed jaw of a hand with a single finger: the part of its palm on which that finger closes.

Where one jaw moves, as in many small grippers, the palm's link is both the block between the jaws and the jaw that stands
still. Only with the two told apart is the palm direction the one in which the jaws point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from dro_grasp.hands.anatomy import PALM
from dro_grasp.hands.hand import Hand

NEARLY_CLOSED = 0.8
"""Share of the way from open to closed at which the jaw is looked for (ours). Closed all the way, jaws often overlap."""
JUST_BEFORE = 0.79
"""Share of the way from which the finger moves there (ours)."""
SLIDING = 0.1
"""Difference in speed along a finger, as a share of its mean, below which it slides rather than turns (ours)."""
KNUCKLE = 0.25
"""Share of the finger beside which the jaw has not begun (ours)."""
LEAST_LENGTH = 0.3
"""Length of a jaw, as a share of the finger's, below which the palm has none (ours)."""
LARGEST_WIDTH = 2.5
"""Width of a jaw, as a multiple of the finger's, above which it is a flat palm (ours)."""


@dataclass(frozen=True)
class FixedJaw:
    """The part of a palm that a finger closes on."""

    mask: Bool[np.ndarray, " n"]
    """The points of the hand that are on it."""
    direction: Float[np.ndarray, "3"]
    """Unit vector from the palm to its end, along the nearly closed finger."""
    length: float
    """How far it extends from there [m]."""


def find_fixed_jaw(
    before: Float[np.ndarray, "n 3"], points: Float[np.ndarray, "n 3"], on_palm: Bool[np.ndarray, " n"],
    on_finger: Bool[np.ndarray, " n"],
) -> FixedJaw | None:
    """The jaw that a nearly closed finger approaches; None if the palm has no such part, as a flat palm or a block alone.

    Along the finger, the jaw begins where the part of the palm ends that the closing finger has passed.

    Args:
        before: Surface points of the hand, JUST_BEFORE it is [m].
        points: The same points when it is NEARLY_CLOSED [m].
        on_palm: Those of the palm.
        on_finger: Those of the finger.
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
    before, after = (hand.points(hand.canonical_joints(1 - share)).numpy() for share in (JUST_BEFORE, NEARLY_CLOSED))
    return find_fixed_jaw(before, after, *((hand.finger_of_link[hand.link_index] == part).numpy() for part in (PALM, 0)))


def _faster(points: Float[np.ndarray, "m 3"], speed: Float[np.ndarray, " m"]) -> Float[np.ndarray, "3"] | None:
    """The direction in which points move faster, from the hinge outwards; None if all move alike."""
    offset = points - points.mean(0)
    gradient = np.linalg.lstsq(offset, speed - speed.mean())[0]
    return gradient if np.ptp(offset @ gradient) > SLIDING * speed.mean() else None


def _unit(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """The vector's direction; zero if it has none."""
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
