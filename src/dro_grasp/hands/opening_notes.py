"""Notes on how far a hand opens: what its open posture leaves out of the joints' ranges, and fingers behind the palm in it."""

from __future__ import annotations

import math

from dro_grasp.descriptions.notes import Note
from dro_grasp.hands.anatomy import Finger
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.opening import BEHIND, FingerMotion


def opening_notes(hand: Hand) -> list[Note]:
    """What the open posture leaves out, finger by finger, and the fingers that point behind the palm in it."""
    bends = hand.movable & ~hand.abduction
    behind = FingerMotion.of(hand).behind(hand.canonical_joints(1.0), bends, hand.palm_direction_wrist).tolist()
    notes = []
    for finger, angle in zip(hand.fingers, behind, strict=True):
        tip, left_out = hand.tree.link_names[finger.tip], _left_out(hand, finger)
        if left_out:
            notes.append(Note("info", tip, f"can open farther than the open posture, which leaves out {', '.join(left_out)}"))
        if angle > BEHIND:
            text = f"points {math.degrees(angle):.0f} degrees behind the palm in the open posture. Is the palm direction right?"
            notes.append(Note("warning", tip, text + " If so, state another open posture"))
    return notes


def _left_out(hand: Hand, finger: Finger) -> list[str]:
    """For each joint of a finger that can open farther than it does: how much of its range is not used."""
    tree, told = hand.tree, []
    for joint in (tree.moves[finger.tip] & hand.movable).nonzero()[:, 0].tolist():
        limit = float(hand.open_limits[joint])
        share = abs(limit - float(hand.open_ends[joint])) / float(tree.upper[joint] - tree.lower[joint])
        if share > 0:
            told.append(f"{share:.0%} of {tree.joint_names[joint]} ({float(hand.open_ends[joint]):.2f} to {limit:.2f})")
    return told
