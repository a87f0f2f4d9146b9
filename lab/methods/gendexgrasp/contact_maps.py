"""Contact maps: how near a hand comes to each point of an object's surface, as one number that knows no hand.

Source: GenDexGrasp (Li et al. 2023), section III.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

STEEPNESS = 10.0
"""How fast contact falls with the root of the aligned distance [1/sqrt(m)]. Source: GenDexGrasp."""
TRAINING_GAMMA = 1.0
"""How much points beside the normal count as farther away, in labels. Source: the D(R,O) release, whose labels these are."""
FITTING_GAMMA = 2.0
"""The same when a hand is fitted to a map. Source: GenDexGrasp."""
SHORTEST = 1e-6
"""Floor of distances, whose root has an infinite slope at zero [m] (ours)."""
CACHED_PAIRS = 2**17
"""Pairs of points that a processor's cache holds; more at once take two to three times as long (ours)."""
CERTAIN = 0.4
"""Contact above which sharpening takes a point to be touched. Source: GenDexGrasp."""


def contact_map(
    points: Float[Tensor, "*#b m 3"], normals: Float[Tensor, "*#b m 3"], hand: Float[Tensor, "*#b n 3"], gamma: float
) -> Float[Tensor, "*b m"]:
    """Contact of each object point with a hand: 1 where they touch, towards 0 far away; gradients flow to the hand.

    Args:
        points: Points of the object's surface [m].
        normals: Outward unit normals there.
        hand: Points of the hand's surface [m].
        gamma: A hand point at an angle to the normal counts as farther by exp(gamma (1 - cosine)).
    """
    nearest = aligned_nearest(points, normals, hand.detach(), gamma)
    chosen = hand.expand(*nearest.shape[:-1], *hand.shape[-2:]).gather(-2, nearest[..., None].expand(*nearest.shape, 3))
    offset = chosen - points
    distance = (offset.square().sum(-1) + SHORTEST**2).sqrt()
    cosine = (offset * normals).sum(-1) / distance
    apart = distance * (gamma * (1 - cosine)).exp()
    return 2 - 2 * torch.sigmoid(STEEPNESS * apart.sqrt())


@torch.no_grad()
def aligned_nearest(
    points: Float[Tensor, "*#b m 3"], normals: Float[Tensor, "*#b m 3"], hand: Float[Tensor, "*#b n 3"], gamma: float
) -> Int[Tensor, "*b m"]:
    """Which hand point has the least aligned distance to each object point."""
    batch, pairs = torch.broadcast_shapes(points.shape[:-2], hand.shape[:-2]), points.shape[-2] * hand.shape[-2]
    points, normals, hand = (x.expand(*batch, *x.shape[-2:]).reshape(-1, *x.shape[-2:]) for x in (points, normals, hand))
    size = max(1, CACHED_PAIRS // pairs) if hand.device.type == "cpu" else len(hand)
    parts = zip(points.split(size), normals.split(size), hand.split(size), strict=True)
    return torch.cat([_nearest(*part, gamma) for part in parts]).reshape(*batch, -1)


def _nearest(
    points: Float[Tensor, "b m 3"], normals: Float[Tensor, "b m 3"], hand: Float[Tensor, "b n 3"], gamma: float
) -> Int[Tensor, "b m"]:
    centre = points.mean(-2, keepdim=True)  # near the origin, squares of coordinates lose no digits
    points, hand = points - centre, hand - centre
    square = points.square().sum(-1)[..., None] + hand.square().sum(-1)[..., None, :] - 2 * points @ hand.mT
    along = normals @ hand.mT - (normals * points).sum(-1)[..., None]
    reciprocal = square.clamp_min_(SHORTEST**2).rsqrt_()
    # The logarithm of the aligned distance, but for a constant: gamma times minus the cosine, minus log of 1/distance.
    return (along.mul_(reciprocal).mul_(-gamma)).sub_(reciprocal.log_()).argmin(-1)


def sharpened(contact: Float[Tensor, "*b m"]) -> Float[Tensor, "*b m"]:
    """Maps with their touched points raised towards 1. Source: GenDexGrasp."""
    raised = (contact + 1 - contact.amax(-1, keepdim=True).clamp_max(0.5)).clamp_max(1.0)
    return torch.where(contact > CERTAIN, raised, contact)
