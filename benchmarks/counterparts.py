"""Points of two open hands that lie in the same place."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dro_grasp.hands.hand import Hand


def counterparts(a: Hand, b: Hand) -> Int[Tensor, " n_a"]:
    """For each point of one open hand, the point of another open hand in the same place.

    Points are compared in the palm's axes about the grasp centre, after both hands are scaled to one size. One hand is
    mirrored if that fits better, so that a left hand matches a right one.
    """
    ours, theirs = _normalized(a), _normalized(b)
    mirrored = ours * ours.new_tensor([1, -1, 1])
    distances = [torch.cdist(cloud, theirs) for cloud in (ours, mirrored)]
    best = min(distances, key=lambda d: float(d.amin(1).mean() + d.amin(0).mean()))
    return best.argmin(1)


def _normalized(hand: Hand) -> Float[Tensor, "n 3"]:
    """The open hand's points in the palm's axes about the grasp centre, scaled to a root mean square of 1."""
    points = (hand.points(hand.canonical_joints()) - hand.grasp_centre_wrist) @ hand.palm_axes_wrist
    return points / points.square().sum(-1).mean().sqrt()
