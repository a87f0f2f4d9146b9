"""Near-duplicates among grasps."""

from __future__ import annotations

import torch
from jaxtyping import Bool
from torch import Tensor

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand

DUPLICATE_DISTANCE = 0.005
"""Two posed hands whose surface points lie closer together on average count as one grasp [m] (ours)."""
HAND_POINTS = 64
"""Surface points that are compared (ours)."""


def distinct(hand: Hand, grasps: GraspBatch, earlier: GraspBatch | None = None) -> Bool[Tensor, " n"]:
    """Grasps that are not near-duplicates of an earlier grasp of the same object.

    Args:
        earlier: Grasps that come before these; none by default.
    """
    n_earlier = 0 if earlier is None else len(earlier)
    joined = grasps if earlier is None else GraspBatch.concatenate([earlier.bare(), grasps.bare()])
    thin = hand.with_points(min(HAND_POINTS, hand.n_points))
    points = thin.points(joined.joints, joined.T_object_wrist)
    keep = torch.ones(len(joined), dtype=torch.bool)
    names = sorted(set(joined.object))
    owner = torch.tensor([names.index(name) for name in joined.object])
    for i in range(max(1, n_earlier), len(joined)):
        before = (keep[:i] & (owner[:i] == owner[i])).nonzero()[:, 0]
        if len(before):
            apart = (points[before] - points[i]).norm(dim=-1).mean(-1)
            keep[i] = bool(apart.min() >= DUPLICATE_DISTANCE)
    return keep[n_earlier:]
