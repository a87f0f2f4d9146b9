"""A hand's proportions: where fingertips, fingers, thumb and palm are from open to closed.

These numbers mean the same for every hand. Features that a network has learned of the surfaces of a few hands say little of one
that it has never seen. Ours.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.hands.hand import Hand

OPENNESS = (0.9, 0.5, 0.2)  # Shares of the way from closed to open at which a hand is measured (ours)
UNIT = 0.1  # Unit of length, about the size of a palm [m] (ours)
FINGERS = 5.0  # Unit of the number of fingers: those of a human-like hand (ours)
JOINTS = 20.0  # Unit of the number of joints, about those of a human-like hand (ours)


def proportions(hand: Hand, axes: Float[Tensor, "3 3"]) -> Float[Tensor, " f"]:
    """Lengths in UNIT about the grasp centre, along axes that are columns in the wrist frame, and counts.

    For each openness the mean, spread, minimum and maximum of the fingertips, mean and spread of the fingers' surface, and the
    thumb's tip, or zeros without one; then the mean and spread of the open hand's palm, and the numbers of fingers, thumbs and
    joints.
    """
    owner = hand.finger_of_link[hand.link_index]
    found: list[Float[Tensor, " k"]] = []
    poses = [[(x - hand.grasp_centre_wrist) @ axes / UNIT for x in _posed(hand, openness)] for openness in OPENNESS]
    for tips, points in poses:
        thumb = torch.zeros_like(tips[0]) if hand.thumb is None else tips[hand.thumb]
        found += [*_moments(tips), tips.amin(0), tips.amax(0), *_moments(points[owner >= 0]), thumb]
    _, opened = poses[0]
    found += _moments(opened[owner < 0])
    found.append(axes.new_tensor([len(hand.fingers) / FINGERS, float(hand.thumb is not None), hand.tree.n_dof / JOINTS]))
    return torch.cat(found)


def _posed(hand: Hand, openness: float) -> tuple[Float[Tensor, "n_tips 3"], Float[Tensor, "n_hand 3"]]:
    """Ends of fingers and surface points in the wrist frame [m]."""
    q = hand.canonical_joints(openness)
    T = hand.tree.forward(q)[list(hand.tips)]
    return (T[:, :3, :3] @ hand.tip_offsets[..., None])[..., 0] + T[:, :3, 3], hand.points(q)


def _moments(points: Float[Tensor, "n 3"]) -> Float[Tensor, "2 3"]:
    """Mean and standard deviation; zeros of no points, as a palm without a surface has."""
    if not len(points):
        return points.new_zeros(2, 3)
    return torch.stack([points.mean(0), points.std(0, unbiased=False)])
