"""The fixed jaw of a hand with a single finger: the part of its palm on which that finger closes.

Where one jaw moves, as in many small grippers, the palm's link is both the block between the jaws and the jaw that stands
still. Only with the two told apart is the palm direction the one in which the jaws point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.hands.anatomy import PALM
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.opening import FingerMotion

NEARLY_CLOSED = 0.8
"""Share of the way from open to closed at which the jaw is looked for (ours). Closed all the way, jaws often overlap."""
JUST_BEFORE = 0.79
"""Share of the way from which the fingertip moves there in the closing direction (ours)."""
LEAST_LENGTH = 0.3
"""Length of a jaw, as a share of the finger's, below which the palm has none (ours)."""
LARGEST_SHARE = 0.75
"""Share of the palm's surface above which the finger closes on a palm, not on a jaw beside a block (ours)."""


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
    points: Float[np.ndarray, "n 3"], on_palm: Bool[np.ndarray, " n"], on_finger: Bool[np.ndarray, " n"],
    closing: Float[np.ndarray, "3"],
) -> FixedJaw | None:
    """The jaw that a nearly closed finger approaches; None if the palm has no such part: it is flat, or a block alone.

    Along the finger, the jaw begins where the part of the palm ends that the closing finger has passed.

    Args:
        points: Surface points of the hand [m].
        on_palm: Those of the palm.
        on_finger: Those of the finger.
        closing: Unit vector of the motion of the fingertip.
    """
    palm, finger = points[on_palm], points[on_finger]
    outwards = finger.mean(0) - palm.mean(0)
    outwards = outwards - (outwards @ closing) * closing
    if (norm := float(np.linalg.norm(outwards))) < 1e-6:
        return None
    outwards = outwards / norm
    along_palm, along_finger = palm @ outwards, finger @ outwards
    outer_half = finger[along_finger > along_finger.mean()]
    passed = palm @ closing < outer_half.mean(0) @ closing
    begin = along_palm[passed].max(initial=along_finger.min())
    length = float(along_palm.max() - begin)
    mask = on_palm & (points @ outwards > begin)
    if length < LEAST_LENGTH * np.ptp(along_finger) or mask.sum() > LARGEST_SHARE * len(palm):
        return None
    return FixedJaw(mask, outwards, length)


def fixed_jaw_of(hand: Hand) -> FixedJaw | None:
    """The part of the palm that a hand's single finger closes on; None of several fingers."""
    if len(hand.fingers) > 1:
        return None
    before, after = (hand.canonical_joints(1 - share) for share in (JUST_BEFORE, NEARLY_CLOSED))
    on_palm, on_finger = ((hand.finger_of_link[hand.link_index] == part).numpy() for part in (PALM, 0))
    closing = closing_direction(FingerMotion.of(hand), before, after)
    return find_fixed_jaw(hand.points(after).numpy(), on_palm, on_finger, closing)


def closing_direction(
    motion: FingerMotion, before: Float[Tensor, " n_dof"], after: Float[Tensor, " n_dof"]
) -> Float[np.ndarray, "3"]:
    """Unit vector of the first fingertip's motion from one posture to another [rad or m]; zero if it stays."""
    moved = (motion.tips(after) - motion.tips(before))[0]
    return (moved / moved.norm().clamp_min(1e-12)).numpy()
