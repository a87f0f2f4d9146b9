"""Choice of placement and z: of several hands that z moves, the one whose points suit the object best.

Differs from the paper, which decodes the one z that it draws. A draw is one of many grasps that fit the placement, and the
motion of the hand tells before decoding which of them penetrate the object, cross their fingers, stay away from it, or would
push it aside as they close.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dro_grasp.distance_matrix import Segments, segments_of
from dro_grasp.errors import OptionError
from dro_grasp.geometry.distance_field import DistanceField, DistanceFields
from dro_grasp.geometry.se3 import apply, register
from dro_grasp.hands.anatomy import PALM
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import Checked
from dro_grasp.optimize.grasp_energy import Workspace

CROWDING_POINTS = 64  # Hand points, spread evenly, between which the distance of fingers is measured (ours)

FAR = 1e3  # What is added to the distance of points of other links [m] (ours)
LEAST_PART = 1e-6  # Sum of the fingers' parts below which they count as not near at all (ours)


@dataclass(frozen=True)
class ChoicePenalties(Checked):
    """What speaks against a hand; set by trials on training objects (ours)."""

    finger_penetration: float = 1200.0
    """Penalty for the deepest point of a finger inside the object, mean over fingers [1/m]."""
    palm_penetration: float = 800.0
    """The same for the palm [1/m]."""
    margin: float = 0.002
    """Clearance below which a point counts as inside; decoding moves points by some millimetres [m]."""
    clearance: float = 400.0
    """Penalty for the deepest point of the hand in its surroundings [1/m]."""
    gap: float = 150.0
    """Penalty for the distance of a finger from the surface, mean over fingers [1/m]."""
    crowding: float = 500.0
    """Penalty for how much closer than `apart` two fingers come [1/m]."""
    imbalance: float = 10.0
    """Penalty for a mean normal of the object where the fingers are near: they push it to one side as they close."""
    nearness: float = 0.015
    """Distance from the surface over which a finger's part in that mean falls to 1 / e [m]."""
    reach: float = 0.03
    """Fingers farther from the surface than this are all alike [m]."""
    apart: float = 0.012
    """Distance between points of two fingers from which on they do not crowd each other [m]."""


@dataclass(frozen=True)
class ChoiceConfig(Checked):
    """How many placements and z are drawn for each candidate, and the penalties by which one is chosen."""

    placements: int = 2
    """Placements drawn for each candidate; 1 takes the first."""
    draws: int = 16
    """z drawn for each placement; 1 takes the first."""
    finalists: int = 4
    """Of these, how many of the best are compared by all points of the hand; 1 takes the best by the network's points."""
    penalties: ChoicePenalties = ChoicePenalties()
    """What speaks against a moved hand."""

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense.

        Raises:
            OptionError: `placements`, `draws` or `finalists` is not positive.
        """
        super().__post_init__()
        for name in ("placements", "draws", "finalists"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} is {getattr(self, name)}; draw at least one, and compare at least one, for each "
                                  "candidate")

    @staticmethod
    def first() -> ChoiceConfig:
        """The first draw, whatever it is: what the paper does."""
        return ChoiceConfig(placements=1, draws=1, finalists=1)


def choice_scores(
    hand: Hand, field: DistanceField | DistanceFields, points: Float[Tensor, "*b n_points 3"], penalties: ChoicePenalties,
    workspace: Workspace | None = None,
) -> Float[Tensor, "*b"]:
    """How well hands suit the object; higher is better, comparable among hands of one kind.

    Args:
        hand: The hand that was moved or decoded.
        field: Signed distances of the object, from its mesh or from its cloud and normals.
        points: Its surface points then, in the object's frame [m].
        penalties: What speaks against a hand.
        workspace: Where the hand may be, and where it may touch the object.
    """
    workspace = workspace or Workspace()
    distance, normal = field.distances(points)
    place = workspace.contact_region
    wanted = distance if place is None else distance.clamp_min(0) + place.distances(points)[0].clamp_min(0)
    finger = hand.finger_of_link[hand.link_index]

    # Points of other parts are infinitely far away.
    of_finger = finger == hand.pointed_fingers[:, None]
    nearest_of, gap_of = (torch.where(of_finger, d[..., None, :], torch.inf).amin(-1) for d in (distance, wanted))
    score = -penalties.finger_penetration * (penalties.margin - nearest_of).clamp_min(0).mean(-1)
    score = score - penalties.gap * gap_of.clamp(0, penalties.reach).mean(-1)
    part = (-distance.clamp_min(0) / penalties.nearness).exp() * (finger != PALM)
    mean_normal = (part[..., None] * normal).sum(-2) / part.sum(-1, keepdim=True).clamp_min(LEAST_PART)
    score = score - penalties.imbalance * mean_normal.norm(dim=-1)
    # A palm without points is infinitely far away.
    palm = torch.where(finger == PALM, distance, torch.inf).amin(-1)
    score = score - penalties.palm_penetration * (penalties.margin - palm).clamp_min(0)
    if workspace.surroundings is not None:
        closest = workspace.surroundings.distances(points)[0].amin(-1)
        score = score - penalties.clearance * (penalties.margin - closest).clamp_min(0)
    some = hand.spread_rank.argsort()[:CROWDING_POINTS].sort().values
    owner = finger[some]
    rivals = (owner[:, None] != owner) & (owner[:, None] != PALM) & (owner != PALM)
    apart = torch.cdist(points[..., some, :], points[..., some, :])
    return score - penalties.crowding * (penalties.apart - torch.where(rivals, apart, torch.inf).amin((-1, -2))).clamp_min(0)


def posed_cloud(hand: Hand, moved: Float[Tensor, "*b n_points 3"], whole: Hand) -> Float[Tensor, "*b n_whole 3"]:
    """All points of a hand, each with its link where the moved points of a thinned hand are [m].

    z moves each point by itself, so that links bend; what is decoded are rigid links. Points of links that cannot be registered
    take the place of the nearest moved point of their link, or of the hand.

    Args:
        hand: The thinned hand.
        moved: Its points.
        whole: The same hand with all points.
    """
    segments, place, nearest = whole.kept(("posed by", hand.n_points, moved.device), lambda: _places(hand, whole))
    rows = moved.flatten(0, -3)
    own = segments.spread(len(rows))
    poses, _ = register(own.local, own.of_points(rows), own.weight)
    posed = apply(poses[:, place.clamp_min(0)], whole.link_points)
    return torch.where(place[:, None] < 0, rows[:, nearest], posed).unflatten(0, moved.shape[:-2])


def _places(hand: Hand, whole: Hand) -> tuple[Segments, Int[Tensor, " n_whole"], Int[Tensor, " n_whole"]]:
    """Segments of a thinned hand; of each point of the whole one, the place of its link among them or -1, and a near point."""
    device = hand.link_points.device
    segments = segments_of([hand], device)
    place = torch.full((hand.tree.n_links,), -1, device=device)
    place[segments.links[0]] = torch.arange(segments.links.shape[1], device=device)
    other = (hand.link_index != whole.link_index[:, None]) * FAR
    opened = hand.canonical_joints()
    return segments, place[whole.link_index], (torch.cdist(whole.points(opened), hand.points(opened)) + other).argmin(-1)
