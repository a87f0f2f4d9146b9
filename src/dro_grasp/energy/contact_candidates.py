"""Candidate contacts: points on the inner sides of a hand's fingers and palm, and the slots that draw from them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.hands.anatomy import PALM
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import Checked


@dataclass(frozen=True)
class ContactConfig(Checked):
    """Selection of contact candidates."""

    closing: float = 0.55
    """Share of the way from open to closed at which inner sides are determined (ours)."""
    inner_cosine: float = 0.3
    """Least cosine between a candidate's normal and the direction to the grasp centre (ours)."""
    level_weights: tuple[float, ...] = (1.0, 0.35, 0.1)
    """Weights of a finger's links, by their number of joints to the tip (ours); links farther up have no candidates."""
    palm_weight: float = 0.3
    """Weight of the palm as a whole, against 1 for a finger, in the slots that are free (ours)."""
    min_contacts: int = 4
    """Least number of contacts. Source: DexGraspNet (four)."""
    idle: float = 0.6
    """Probability that a finger other than the thumb holds nothing, in hands with a thumb (ours: hands that always use all
    fingers grasp every object alike). The thumb and one more finger always hold."""


@dataclass(frozen=True)
class ContactCandidates:
    """Points of a hand's surface from which contacts are drawn, one per slot."""

    points: Float[Tensor, "k 3"]
    """In their links' frames [m]."""
    normals: Float[Tensor, "k 3"]
    """Outward unit normals in their links' frames."""
    links: Int[Tensor, " k"]
    """The link of each candidate."""
    fingers: Int[Tensor, " k"]
    """Index of the finger of each candidate, or PALM."""
    slot_weights: Float[Tensor, "n_slots k"]
    """Probability of each candidate in each slot; the slots of the fingers come first, the free slots last."""
    slot_finger: tuple[int, ...]
    """Finger of each slot; PALM for the free slots."""
    thumb: int | None
    """Index of the thumb, which always holds; None if all fingers do."""

    def draw(self, n: int, generator: torch.Generator) -> Int[Tensor, "n n_slots"]:
        """Random candidates, one for each grasp and slot, drawn on the CPU."""
        return torch.multinomial(self.slot_weights.cpu(), n, replacement=True, generator=generator).T

    def assign(self, n: int, idle: float, generator: torch.Generator) -> Int[Tensor, "n n_slots"]:
        """The slot from which each contact of each grasp draws: its own, or another one if its finger is idle.

        `idle` is the probability of that for a finger other than the thumb.
        """
        own = torch.arange(len(self.slot_finger)).repeat(n, 1)
        if self.thumb is None:
            return own
        chance = torch.rand(own.shape, generator=generator)
        fingers = torch.tensor(self.slot_finger)
        may_rest = (fingers != PALM) & (fingers != self.thumb)
        partner = torch.where(may_rest, chance, -torch.inf).argmax(-1, keepdim=True)
        resting = may_rest & (chance < idle) & (own != partner)
        substitute = torch.multinomial((~resting).float(), own.shape[1], replacement=True, generator=generator)
        return torch.where(resting, substitute, own)


def contact_candidates(hand: Hand, config: ContactConfig | None = None) -> ContactCandidates:
    """Candidate contacts on the inner sides of fingers and palm, and their probabilities in each slot.

    There are as many slots as fingers, but at least `min_contacts`. Each finger has a slot of its own, so the thumb always
    holds; the other slots are free to use any finger or the palm. A single finger presses on the palm, which has a slot of its
    own then and counts as much as the finger.
    """
    config = config or ContactConfig()
    q = hand.canonical_joints(1 - config.closing)
    points, normals = hand.points_and_normals(q)
    towards = hand.grasp_centre_wrist - points
    cosine = (normals * towards).sum(-1) / towards.norm(dim=-1).clamp_min(1e-9)
    finger = hand.finger_of_link[hand.link_index]
    inner = (cosine > config.inner_cosine) & torch.isin(hand.link_index, torch.tensor(hand.contact_links))
    by_level = _level_weights(hand, config)[hand.link_index]
    weight = by_level * cosine.clamp_min(0)
    weight = torch.where(_without_any(weight > 0, finger), by_level, weight)
    inner = (inner | _without_any(inner & (weight > 0), finger)) & (weight > 0)
    keep = inner.nonzero()[:, 0]
    slots = _slots(finger[keep], weight[keep].clamp_min(1e-6), len(hand.fingers), config)
    return ContactCandidates(
        hand.link_points[keep], hand.link_normals[keep], hand.link_index[keep], finger[keep], *slots, thumb=hand.thumb
    )


def _level_weights(hand: Hand, config: ContactConfig) -> Float[Tensor, " n_links"]:
    """Weight of each link's candidates: by the number of joints to the tip on fingers, uniform on the palm."""
    weights = torch.full((hand.tree.n_links,), config.palm_weight)
    levels = torch.tensor([*config.level_weights, 0.0])
    for finger in hand.fingers:
        level = torch.tensor(finger.joints_to_tip, dtype=torch.int64)
        weights[list(finger.links)] = levels[level.clamp_max(len(levels) - 1)]
    return weights


def _without_any(chosen: Bool[Tensor, " n"], finger: Int[Tensor, " n"]) -> Bool[Tensor, " n"]:
    """The points of fingers of which no point is chosen."""
    return (finger != PALM) & ~torch.isin(finger, finger[chosen])


def _slots(
    finger: Int[Tensor, " k"], weight: Float[Tensor, " k"], n_fingers: int, config: ContactConfig
) -> tuple[Float[Tensor, "n_slots k"], tuple[int, ...]]:
    """The slots' weights and their fingers; the slot of a finger without candidates is a free one."""
    rows, palm = [_normalised(weight * (finger == i)) for i in range(n_fingers)], _normalised(weight * (finger == PALM))
    alone = n_fingers == 1
    free = _normalised(torch.stack(rows).sum(0) + (1.0 if alone else config.palm_weight) * palm)
    owners = [i if bool(row.any()) else PALM for i, row in enumerate(rows)]
    slots = [free if i == PALM else rows[i] for i in owners] + ([palm] if alone and bool(palm.any()) else [])
    extra = max(0, config.min_contacts - len(slots))
    return torch.stack(slots + [free] * extra), tuple(owners + [PALM] * (len(slots) - len(owners) + extra))


def _normalised(row: Float[Tensor, " k"]) -> Float[Tensor, " k"]:
    return row / row.sum().clamp_min(1e-9)
