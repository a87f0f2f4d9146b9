"""Spheres that stand for the links where self-penetration is measured."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.geometry import se3
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.opening import open_side_by_side


@dataclass(frozen=True)
class LinkSpheres:
    """Spheres that fill the links, and the pairs of them that must not overlap."""

    centres: Float[Tensor, "s 3"]
    """In their links' frames [m]."""
    radii: Float[Tensor, " s"]
    """[m]"""
    links: Int[Tensor, " s"]
    """The link of each sphere."""
    pairs: Int[Tensor, "k 2"]
    """Pairs to keep apart."""


def link_spheres(hand: Hand) -> LinkSpheres:
    """Spheres along the longest axis of each link, from its surface points.

    Pairs on links of one rigid group or of neighbouring groups, and pairs that overlap in the open hand, fingers side by side,
    may touch.
    """
    centres, radii, links = [], [], []
    for link in hand.link_index.unique().tolist():
        points = hand.link_points[hand.link_index == link]
        if len(points) < 4:
            continue
        for centre, radius in _fill(points):
            centres.append(centre)
            radii.append(radius)
            links.append(link)
    centre, radius, link_of = torch.stack(centres), torch.stack(radii), torch.tensor(links)
    pairs = torch.combinations(torch.arange(len(links)), 2)
    near = _neighbours(hand)
    pairs = pairs[~near[link_of[pairs[:, 0]], link_of[pairs[:, 1]]]]
    poses = hand.tree.forward(open_side_by_side(hand, 0.9))[link_of]
    placed = se3.apply(poses, centre)
    apart = (placed[pairs[:, 0]] - placed[pairs[:, 1]]).norm(dim=-1)
    pairs = pairs[apart > radius[pairs[:, 0]] + radius[pairs[:, 1]]]
    return LinkSpheres(centre, radius, link_of, pairs)


def _fill(points: Float[Tensor, "n 3"]) -> list[tuple[Float[Tensor, "3"], Float[Tensor, ""]]]:
    """Centres [m] and radii [m] of spheres along the longest axis of a set of surface points."""
    middle = (points.amin(0) + points.amax(0)) / 2
    axes = torch.linalg.svd(points - points.mean(0), full_matrices=False)[2]
    local = (points - middle) @ axes.T
    low, high = local.amin(0), local.amax(0)
    half = (high - low) / 2
    radius = half[1:].amin().clamp_min(0.002)
    count = max(1, min(6, round(float(half[0] / radius))))
    along = (high[0] + low[0]) / 2 + (half[0] - radius).clamp_min(0) * torch.linspace(-1, 1, count)
    if count == 1:
        along = ((high[0] + low[0]) / 2)[None]
    across = (high + low) / 2
    return [(middle + torch.stack([a, across[1], across[2]]) @ axes, radius) for a in along]


def _neighbours(hand: Hand) -> Bool[Tensor, "n_links n_links"]:
    """Whether at most one moving joint lies between two links."""
    group = torch.tensor(hand.rigid_group)
    adjacent = torch.eye(hand.tree.n_links, dtype=torch.bool)
    for link, parent in enumerate(hand.tree.parent):
        if parent >= 0:
            above, below = hand.rigid_group[parent], hand.rigid_group[link]
            adjacent[above, below] = adjacent[below, above] = True
    return adjacent[group[:, None], group]
