"""What of a hand can hold: its fingers, the thumb, and the candidate contact points on their inner sides.

Everything is derived from the tree, the fingertips and the surface points; nothing is annotated.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.hands.hand import Hand
from dro_grasp.kinematics.tree import KinematicTree

PALM = -1
"""The finger number of contact points that lie on the palm."""


@dataclass(frozen=True)
class ContactConfig:
    """Where a hand may touch."""

    closing: float = 0.55
    """Share of the way from open to closed at which inner sides are judged."""
    inner_cosine: float = 0.3
    """Least cosine between a candidate's normal and the direction to the grasp centre."""
    level_weights: tuple[float, ...] = (1.0, 0.35, 0.1)
    """Weight of a finger's links, from the distal one towards the palm; links beyond have no candidates."""
    palm_weight: float = 0.3
    """Weight of the palm as a whole, against 1 for a finger, among the contacts not tied to a finger."""
    min_contacts: int = 4
    """Least number of contacts. Source: DexGraspNet (four)."""
    idle: float = 0.6
    """Probability that a finger other than the thumb holds nothing, in hands that have a thumb (ours: a hand that
    always uses all fingers grasps everything alike). The thumb and one more finger always hold."""


@dataclass(frozen=True)
class ContactCandidates:
    """Points of a hand's surface that contacts are chosen from."""

    points: Float[Tensor, "k 3"]
    """In their links' frames [m]."""
    normals: Float[Tensor, "k 3"]
    """Outward unit normals in their links' frames."""
    links: Int[Tensor, " k"]
    """The link of each candidate."""
    fingers: Int[Tensor, " k"]
    """The finger of each candidate, or PALM."""
    slot_weights: Float[Tensor, "n_slots k"]
    """Probability of each candidate in each slot; slots that stay on one finger come first."""
    slot_finger: tuple[int, ...]
    """Finger of each slot; PALM for the free slots."""
    thumb: int | None
    """The finger that always holds; None where all of them do."""

    def draw(self, n: int, generator: torch.Generator) -> Int[Tensor, "n n_slots"]:
        """Random candidates, one for each grasp and slot, drawn on the CPU."""
        return torch.multinomial(self.slot_weights.cpu(), n, replacement=True, generator=generator).T

    def assign(self, n: int, idle: float, generator: torch.Generator) -> Int[Tensor, "n n_slots"]:
        """The slot whose candidates each contact of each grasp uses: its own, or another where its finger is idle.

        Args:
            n: How many grasps.
            idle: Probability that a finger other than the thumb is idle.
            generator: Source of randomness.
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


def finger_links(tree: KinematicTree, tips: tuple[int, ...], palm: int) -> Int[Tensor, " n_links"]:
    """The finger (index into `tips`) of each link; PALM for the palm and for links of several fingers.

    A link belongs to the finger whose tip it carries, or else to that of its nearest ancestor which has one.
    """
    finger = [PALM] * tree.n_links
    for link in range(tree.n_links):
        carried = [i for i, tip in enumerate(tips) if bool(tree.descends[tip, link])]
        below_palm = bool(tree.descends[link, palm]) and link != palm
        if below_palm and len(carried) == 1:
            finger[link] = carried[0]
        elif below_palm and not carried:
            finger[link] = finger[tree.parent[link]]
    rigid = rigid_group(tree, palm)
    return torch.tensor([PALM if rigid[i] else f for i, f in enumerate(finger)])


def rigid_group(tree: KinematicTree, link: int) -> list[bool]:
    """The links that are fixed to `link`, itself included."""
    group = [False] * tree.n_links
    for other in range(tree.n_links):
        parent = tree.parent[other]
        group[other] = other == link or (parent >= 0 and group[parent] and tree.link_joint[other] < 0)
    return group


def joints_to_tip(tree: KinematicTree, tip: int) -> Int[Tensor, " n_links"]:
    """For each link, how many moving joints lie between it and the tip that it carries; 0 for all others."""
    level = torch.zeros(tree.n_links, dtype=torch.int64)
    count, link = 0, tip
    while link >= 0:
        level[link] = count
        count += tree.link_joint[link] >= 0
        link = tree.parent[link]
    return level


def closing_directions(hand: Hand, closing: float) -> Float[Tensor, "n_tips 3"]:
    """Unit velocity of each fingertip in the wrist frame while the whole hand closes."""
    q = hand.canonical_joints(1 - closing)
    poses = hand.tree.forward(q)
    tips = torch.tensor(hand.tips)
    jacobian = hand.tree.point_jacobian(poses, poses[tips, :3, 3] + _tip_shift(hand, poses), tips)
    span = hand.tree.upper - hand.tree.lower
    rate = -hand.opening * span * (hand.movable & ~hand.abduction)
    velocity = jacobian @ rate
    return velocity / velocity.norm(dim=-1, keepdim=True).clamp_min(1e-9)


def _tip_shift(hand: Hand, poses: Float[Tensor, "n_links 4 4"]) -> Float[Tensor, "n_tips 3"]:
    rotation = poses[torch.tensor(hand.tips), :3, :3]
    return (rotation @ hand.tip_offsets[..., None])[..., 0]


def find_thumb(hand: Hand, closing: float) -> int | None:
    """The finger whose closing direction opposes the others most; None for hands of two or three fingers.

    Fingers of such hands all oppose each other, and all of them hold.
    """
    if len(hand.tips) <= 3:
        return None
    directions = closing_directions(hand, closing)
    others = (directions.sum(0) - directions) / (len(directions) - 1)
    return int((directions * others).sum(-1).argmin())


def contact_candidates(hand: Hand, config: ContactConfig | None = None) -> ContactCandidates:
    """Candidate contacts on the inner sides of fingers and palm, and which slot may use which.

    There are as many contacts as fingers, at least `min_contacts`; each finger has a slot of its own (so the
    thumb always holds), further slots are free to use any finger or the palm.
    """
    config = config or ContactConfig()
    q = hand.canonical_joints(1 - config.closing)
    points, normals = hand.points_and_normals(q)
    centre = hand.grasp_centre_wrist
    towards = centre - points
    cosine = (normals * towards).sum(-1) / towards.norm(dim=-1).clamp_min(1e-9)
    finger = finger_links(hand.tree, hand.tips, hand.palm)[hand.link_index]
    inner = (cosine > config.inner_cosine) & torch.isin(hand.link_index, torch.tensor(hand.touching))
    weight = _level_weights(hand, finger, config) * cosine.clamp_min(0)
    inner = _never_empty(inner, weight, finger, len(hand.tips)) & (weight > 0)
    keep = inner.nonzero()[:, 0]
    slots = _slots(finger[keep], weight[keep].clamp_min(1e-6), len(hand.tips), config)
    return ContactCandidates(
        hand.link_points[keep], hand.link_normals[keep], hand.link_index[keep], finger[keep], *slots,
        thumb=find_thumb(hand, config.closing),
    )


def _level_weights(hand: Hand, finger: Int[Tensor, " n"], config: ContactConfig) -> Float[Tensor, " n"]:
    table = torch.zeros(len(hand.tips) + 1, hand.tree.n_links)
    levels = torch.tensor([*config.level_weights, 0.0])
    for i, tip in enumerate(hand.tips):
        table[i] = levels[joints_to_tip(hand.tree, tip).clamp_max(len(levels) - 1)]
    table[PALM] = config.palm_weight
    return table[finger, hand.link_index]


def _never_empty(
    inner: Bool[Tensor, " n"], weight: Float[Tensor, " n"], finger: Int[Tensor, " n"], n_fingers: int
) -> Bool[Tensor, " n"]:
    """Let a finger without any inner point use all its points rather than none."""
    result = inner.clone()
    for i in range(n_fingers):
        if not (inner & (finger == i) & (weight > 0)).any():
            result |= finger == i
    return result


def _slots(
    finger: Int[Tensor, " k"], weight: Float[Tensor, " k"], n_fingers: int, config: ContactConfig
) -> tuple[Float[Tensor, "n_slots k"], tuple[int, ...]]:
    rows = []
    for i in range(n_fingers):
        row = weight * (finger == i)
        rows.append(row / row.sum())
    free = torch.stack(rows).sum(0) + config.palm_weight * _normalised(weight * (finger == PALM))
    extra = max(0, config.min_contacts - n_fingers)
    rows += [free / free.sum()] * extra
    return torch.stack(rows), (*range(n_fingers), *(PALM,) * extra)


def _normalised(row: Float[Tensor, " k"]) -> Float[Tensor, " k"]:
    return row / row.sum().clamp_min(1e-9)
