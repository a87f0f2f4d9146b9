"""Points and spheres on a hand's links, and the candidates from which contacts are drawn."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.geometry import se3
from dro_grasp.hands.anatomy import PALM
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.opening import open_side_by_side
from dro_grasp.kinds import Checked


@dataclass(frozen=True)
class LinkPoints:
    """Points fixed to links, laid out so that one matrix product places them all.

    The poses of a grasp, as one row of 4 n_links entries for each of x, y and z, times the layout give the coordinates of all
    points: each point's column holds its homogeneous coordinates in the four rows of its own link, and zeros elsewhere.
    """

    layout: Float[Tensor, "rows p"]  # the columns; rows is 4 n_links [m]
    members: Float[Tensor, "p n_links"]  # one-hot link of each point

    @staticmethod
    def of(local: Float[Tensor, "p 3"], links: Int[Tensor, " p"], n_links: int) -> LinkPoints:
        """Lay out points given in their links' frames."""
        members = torch.eye(n_links, dtype=local.dtype, device=local.device)[links]
        homogeneous = torch.cat([local, torch.ones_like(local[:, :1])], -1)
        layout = (members[:, :, None] * homogeneous[:, None, :]).flatten(1).T.contiguous()
        return LinkPoints(layout, members)

    def beside(self, others: LinkPoints) -> LinkPoints:
        """These points, and then others."""
        return LinkPoints(torch.cat([self.layout, others.layout], 1), torch.cat([self.members, others.members]))

    def place(self, poses: Float[Tensor, "n n_links 4 4"]) -> Float[Tensor, "n p 3"]:
        """The points in the world [m]."""
        rows = poses[:, :, :3].transpose(1, 2).reshape(3 * len(poses), -1)
        return (rows @ self.layout).unflatten(0, (-1, 3)).mT


@dataclass(frozen=True)
class LinkSpheres:
    """Spheres that fill the links, and the pairs of them that must not overlap."""

    centres: Float[Tensor, "s 3"]  # in their links' frames [m]
    radii: Float[Tensor, " s"]  # [m]
    links: Int[Tensor, " s"]
    pairs: Int[Tensor, "k 2"]


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


@dataclass(frozen=True)
class ContactConfig(Checked):
    """Selection of contact candidates."""

    closing: float = 0.55  # share of the way from open to closed at which inner sides are determined (ours)
    inner_cosine: float = 0.3  # least cosine between a candidate's normal and the direction to the grasp centre (ours)
    level_weights: tuple[float, ...] = (1.0, 0.35, 0.1)
    """Weights of a finger's links, by their number of joints to the tip (ours); links farther up have no candidates."""
    palm_weight: float = 0.3  # weight of the palm as a whole, against 1 for a finger, in the slots that are free (ours)
    min_contacts: int = 4  # least number of contacts. Source: DexGraspNet (four).
    idle: float = 0.6
    """Probability that a finger other than the thumb holds nothing, in hands with a thumb (ours: hands that always use all
    fingers grasp every object alike). The thumb and one more finger always hold."""


@dataclass(frozen=True)
class ContactCandidates:
    """Points of a hand's surface from which contacts are drawn, one per slot."""

    points: Float[Tensor, "k 3"]  # in their links' frames [m]
    normals: Float[Tensor, "k 3"]  # outward unit normals in their links' frames
    links: Int[Tensor, " k"]
    fingers: Int[Tensor, " k"]  # index of the finger of each candidate, or PALM
    slot_weights: Float[Tensor, "n_slots k"]
    """Probability of each candidate in each slot; the slots of the fingers come first, the free slots last."""
    slot_finger: tuple[int, ...]  # finger of each slot; PALM for the free slots
    thumb: int | None  # index of the thumb, which always holds; None if all fingers do

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


def tip_links(hand: Hand) -> list[int]:
    """Links that move with a fingertip."""
    return sorted({link for finger in hand.fingers
                   for link, joints in zip(finger.links, finger.joints_to_tip, strict=True) if joints == 0})
