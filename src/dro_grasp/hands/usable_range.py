"""The range in which joints are of use, where limits say nothing: no finger turns once around itself.

Fingers are taken to bend about as far as those of other hands from where they are straight, and to close until they reach the
palm. What the limits do say stays as it is.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from torch import Tensor

from dro_grasp.hands.anatomy import JointMask, Joints
from dro_grasp.hands.closing import Closing
from dro_grasp.hands.description.compiling import Note
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.kinematics.tree import KinematicTree
from dro_grasp.hands.opening import FingerMotion

NONSENSE = 2 * math.pi - 0.1
"""Range from which on the limits of a finger's joint say nothing [rad] (ours): a whole turn, or half of one both ways, as
joints without limits get."""
FARTHEST_BEND = 1.75  # Angle by which such a joint bends at most [rad] (ours): 100 degrees; joints of hands bend by 1.3 to 1.9
FARTHEST_SPREAD = 0.35  # The same for joints that spread fingers [rad] (ours): people's spread by 20 degrees
STRAIGHT = 0.85  # Share of its longest reach from which on a finger is straight at rest (ours)
AT_PALM = 0.012  # Distance from the palm at which the middle of a fingertip has reached it [m] (ours): half of its thickness
BEYOND = 0.1  # Share of the way to there by which fingers may close farther (ours)
STEPS = 41  # Postures on the way from open to closed at which fingertips are looked for at the palm (ours)


def without_sense(tree: KinematicTree, movable: JointMask) -> JointMask:
    """Joints of fingers whose limits say nothing."""
    return movable & (tree.joint_unit == 1) & (tree.upper - tree.lower > NONSENSE)


def sensibly_limited(motion: FingerMotion, rest: Joints, movable: JointMask, stated: Joints) -> KinematicTree:
    """The tree with limits of joints that had none, about straight fingers: those at rest, or the posture that is stated."""
    tree = motion.tree
    if not bool((wide := without_sense(tree, movable)).any()):
        return tree
    start = torch.where(stated.isnan(), rest, stated)
    straight = motion.straightest(start, wide & stated.isnan())
    reach, longest = (motion.reaches(q, movable).norm(dim=-1) for q in (start, straight))
    for finger, enough in zip(motion.fingers, (reach >= STRAIGHT * longest).tolist(), strict=True):
        if enough:
            straight = torch.where(tree.moves[finger.tip], start, straight)
    lower = torch.where(wide, (straight - FARTHEST_BEND).maximum(tree.lower), tree.lower)
    upper = torch.where(wide, (straight + FARTHEST_BEND).minimum(tree.upper), tree.upper)
    return dataclasses.replace(tree, lower=lower, upper=upper)


def in_use(
    motion: FingerMotion, wide: JointMask, closing: Closing, rest: Joints, palm_points: Float[np.ndarray, "n 3"]
) -> KinematicTree:
    """The tree with limits of such joints where fingers are open, and where they reach the palm or are bent the farthest.

    `motion` has the limits with which the closing was found; points of the palm are in the root link's frame [m].
    """
    tree, ends = motion.tree, closing.open_ends
    if not bool(wide.any()):
        return tree
    farthest = torch.where(closing.opening_signs > 0, tree.lower, tree.upper)
    bends = wide & ~closing.abduction
    shares = torch.linspace(0, 1, STEPS)
    path = torch.where(closing.abduction, rest, ends + shares[:, None] * (farthest - ends))
    away = torch.from_numpy(KDTree(palm_points).query(motion.tips(path).numpy())[0])
    for column, finger in enumerate(motion.fingers):
        first = _reaching(away[:, column] < AT_PALM)
        share = 1.0 if first is None else min(1.0, float(shares[first]) * (1 + BEYOND))
        farthest = torch.where(bends & tree.moves[finger.tip], ends + share * (farthest - ends), farthest)
    middle = rest.clamp(tree.lower, tree.upper)
    spread = wide & closing.abduction
    lower, upper = torch.minimum(ends, farthest), torch.maximum(ends, farthest)
    lower = torch.where(spread, middle - FARTHEST_SPREAD, torch.where(bends, lower, tree.lower))
    upper = torch.where(spread, middle + FARTHEST_SPREAD, torch.where(bends, upper, tree.upper))
    return dataclasses.replace(tree, lower=lower, upper=upper)


def _reaching(at_palm: Bool[Tensor, " steps"]) -> int | None:
    """The first step at which a fingertip comes to the palm; it may have begun there."""
    arrives = at_palm[1:] & ~at_palm[:-1]
    return int(arrives.float().argmax()) + 1 if bool(arrives.any()) else None


def range_notes(hand: Hand) -> list[Note]:
    """Joints whose limits say nothing, and what is taken instead."""
    if hand.description is None:
        return []
    stated = hand.description.tree
    return [Note("info", name, f"has limits of {stated.lower[j]:.2f} to {stated.upper[j]:.2f}, more than a finger turns; "
                 f"{hand.tree.lower[j]:.2f} to {hand.tree.upper[j]:.2f} is used. State limits if it goes farther")
            for j, name in enumerate(hand.tree.joint_names) if bool(without_sense(stated, hand.movable)[j])]
