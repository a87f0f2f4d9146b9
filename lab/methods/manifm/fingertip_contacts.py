"""Where fingertips touch: pads of a hand, and heat maps and forces on an object's points. Source: ManiFM (Xu et al. 2024)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dro_grasp.hands.hand import Hand
from dro_grasp.optimize.contacts import contact_candidates
from dro_grasp.optimize.grasp_energy import NearestPoints
from dro_grasp.optimize.squeeze import GripConfig, contact_forces

REACH = GripConfig.reach
"""Fingers nearer than this to the object are taken to touch it [m]: as where squeezes are made."""
WIDTH = 0.01
"""Standard deviation of the heat around a contact [m] (ours)."""


@dataclass(frozen=True)
class Pads:
    """The middle of each finger's inner side at its tip."""

    points: Float[Tensor, "f 3"]
    """In their links' frames [m]."""
    normals: Float[Tensor, "f 3"]
    """Outward unit normals."""
    links: Int[Tensor, " f"]

    @staticmethod
    def of(hand: Hand) -> Pads:
        """The likeliest contact candidate of each finger; fingers without any have no pad."""
        found = contact_candidates(hand)
        rows = [int(row.argmax()) for row, finger in zip(found.slot_weights, found.slot_finger, strict=True) if finger >= 0]
        return Pads(found.points[rows], found.normals[rows], found.links[rows])


@dataclass(frozen=True)
class ContactMaps:
    """Contacts of grasps as the network sees them."""

    heat: Float[Tensor, "b m"]
    """1 at a contact, 0 far from any."""
    force: Float[Tensor, "b m 3"]
    """Force on the object there, as a share of the sum of normal forces."""


def contact_maps(
    points: Float[Tensor, "b m 3"], normals: Float[Tensor, "b m 3"], hand: Hand, body: Float[Tensor, "b n 3"]
) -> ContactMaps:
    """Heat and balanced forces that posed hands leave on objects.

    Args:
        points: Points of the objects' surfaces [m].
        normals: Outward unit normals there.
        hand: The hand.
        body: Its surface points in the grasps [m].
    """
    owner = hand.finger_of_link[hand.link_index]
    apart = torch.cdist(body, points)
    near = torch.stack([apart[:, owner == i].amin(1) for i in range(len(hand.fingers))], 1)  # b f m
    gap, index = near.min(-1)
    spots, outward = (values.gather(1, index[..., None].expand(-1, -1, 3)) for values in (points, normals))
    touches = gap < REACH
    count, config = near.shape[1], GripConfig()
    records = NearestPoints(torch.arange(count), index, spots, -outward, gap, outward)
    centre = points.mean(1, keepdim=True)
    length = float((points - centre).norm(dim=-1).mean())
    shifted = NearestPoints(records.links, index, spots - centre, -outward, gap, outward)
    forces = contact_forces(shifted, touches, torch.eye(count, dtype=torch.bool), torch.zeros(3), length, config) / config.force
    square = torch.where(touches[..., None], torch.cdist(spots, points).square(), torch.inf)
    heat, finger = (-square / (2 * WIDTH**2)).exp().max(1)
    return ContactMaps(heat, heat[..., None] * forces.gather(1, finger[..., None].expand(-1, -1, 3)))


def contacts_of(
    points: Float[Tensor, "m 3"], heat: Float[Tensor, "b m"], count: int, radius: float
) -> Int[Tensor, "b count"]:
    """The hottest points that are no nearer than a radius to each other (non-maximum suppression), the hottest first."""
    apart, left = torch.cdist(points, points), heat.clone()
    chosen = []
    for _ in range(count):
        best = left.argmax(-1)
        chosen.append(best)
        left = torch.where(apart[best] < radius, -torch.inf, left)
    return torch.stack(chosen, -1)
