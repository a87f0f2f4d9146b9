"""How likely grasps are to hold, as far as geometry tells: what each link does at the object's surface, judged by a network.

Differs from the paper, which ranks by the grasp energy alone: the energy knows nothing of the closing motion, and being pushed
away by fingers that arrive one after the other is what most predicted grasps fail of.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.energy.grasp_energy import GraspEnergy
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import completed

NEAR = 0.005
"""Distance from the surface at which a link counts for a third [m]."""
LENGTH, MOTION = 0.05, 0.01
"""Sizes of a position and of a motion that the network sees as 1 [m]."""
FARTHEST = 0.05
"""Links farther away than this are all alike [m]."""


class GraspFeatures(NamedTuple):
    """What the network sees of n grasps; in the palm's axes, so that all hands look alike."""

    links: Float[Tensor, "n l 16"]
    """Per link with points of its own: at the one nearest to the surface, gap, object's normal, position about the object's
    centre, motions when closing from the pregrasp and to the squeeze, and how they and the hand's normal meet the surface."""
    nearness: Float[Tensor, "n l"]
    """From 0 to 1."""
    whole: Float[Tensor, "n 8"]
    """Energy terms, object's size, closeness of the grasp centre to the object's."""


def grasp_features(energy: GraspEnergy, grasps: GraspBatch, terms: Float[Tensor, "n 6"]) -> GraspFeatures:
    """Features of grasps.

    Args:
        energy: The hand on the object.
        grasps: Grasps of the two.
        terms: Weighted terms of the energy.
    """
    hand = energy.hand
    grasps = completed(hand, grasps, energy.centre)
    T, q, pregrasp, squeeze = grasps.T_object_wrist, grasps.joints, grasps.pregrasp_joints, grasps.squeeze_joints
    points, normals = hand.points_and_normals(q, T)
    before, after = hand.points(pregrasp, T), hand.points(squeeze, T)
    distance, gradient = energy.field.distances(points)
    chosen = torch.stack([
        torch.where(hand.link_index == link, distance, torch.inf).argmin(1) for link in hand.link_index.unique().tolist()], 1)

    def pick(values: Tensor) -> Tensor:
        return values.gather(1, chosen[..., None].expand(-1, -1, 3))

    axes = T[:, :3, :3] @ hand.palm_axes_wrist
    gap = distance.gather(1, chosen)
    normal, own, place = (pick(v) for v in (torch.nn.functional.normalize(gradient, dim=-1), normals, points))
    arriving, closing = pick(points - before), pick(after - points)
    palm = (hand.link_index.unique() == hand.palm).to(gap).expand_as(gap)
    scalars = [
        gap.clamp(-FARTHEST, FARTHEST) / MOTION, (own * normal).sum(-1), -(arriving * normal).sum(-1) / MOTION,
        -(closing * normal).sum(-1) / MOTION, palm,
    ]
    nearness = torch.exp(-gap.clamp_min(0) / NEAR)
    vectors = [normal @ axes, (place - energy.centre) @ axes / LENGTH, closing @ axes / MOTION]
    links = torch.cat([torch.stack([*scalars, nearness], -1), *vectors], -1)
    links = torch.cat([links, (gap < FARTHEST).to(gap)[..., None]], -1)
    centre = (hand.grasp_centres(T) - energy.centre).norm(dim=-1)
    size = torch.full_like(centre, energy.length)
    whole = torch.cat([terms.clamp_min(0).log1p(), torch.stack([size, centre], -1) / LENGTH], -1)
    return GraspFeatures(links, nearness, whole)
