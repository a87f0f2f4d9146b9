"""Coverage of a data set: palm directions, wrist rolls, grasp sizes and joints of its grasps."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.compare.metrics import diversity
from dro_grasp.errors import GraspFileError, HandError
from dro_grasp.frames import HALF_AXES, half_axis
from dro_grasp.geometry import se3
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import CONTACT_LINKS, HAND_FILE
from dro_grasp.grasps.sources import hand_of
from dro_grasp.hands.hand import Hand
from dro_grasp.training.data.collections.collection import PairGrasps
from dro_grasp.training.data.engine.shards import Yield

ROLL_BINS = 8  # Sectors of 45 degrees that wrist rolls are counted in


@dataclass(frozen=True)
class PairCoverage:
    """One hand on one object."""

    object: str
    grasps: int  # in the data set
    yields: Yield  # what became of the candidates in synthesis; the data set may hold only some of the valid grasps
    half_axes: tuple[int, ...]  # grasps by the half-axis nearest to their palm direction, in the order of HALF_AXES
    rolls: int  # how many of the ROLL_BINS sectors of wrist roll have a grasp
    size: tuple[float, float]  # smallest and largest grasp size [m]; NaN without grasps
    contact_links: tuple[int, int]  # fewest and most links in contact after closing; zero if not recorded

    @property
    def reason(self) -> str:
        """Why there is no grasp; empty if there is one."""
        return "" if self.grasps else self.yields.main_obstacle()


@dataclass(frozen=True)
class HandCoverage:
    """One hand on all its objects."""

    hand: Hand
    grasps: GraspBatch
    pairs: tuple[PairCoverage, ...]
    diversity: dict[str, float]  # diversity over all objects together: all, wrist, joints

    @property
    def yields(self) -> Yield:
        """What became of all candidates."""
        return sum((pair.yields for pair in self.pairs), Yield())

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "hand": self.grasps.hand, "grasps": len(self.grasps), "diversity": self.diversity,
            "yield": self.yields.to_dict(), "per_cpu_hour": self.yields.per_cpu_hour,
            "objects": [
                {"object": p.object, "grasps": p.grasps, "yield": p.yields.to_dict(), "per_cpu_hour": p.yields.per_cpu_hour,
                 "half_axes": dict(zip(HALF_AXES, p.half_axes, strict=True)), "rolls": p.rolls, "size": list(p.size),
                 "reason": p.reason}
                for p in self.pairs
            ],
        }


def measure_coverage(pairs: Iterable[PairGrasps]) -> list[HandCoverage]:
    """Coverage of each hand of a data set; one without any grasp, whose file nothing names, is left out."""
    by_hand: dict[str, list[PairGrasps]] = {}
    for pair in of_one_version((None, pair) for pair in pairs):
        by_hand.setdefault(pair.grasps.hand, []).append(pair)
    return [found for _, group in sorted(by_hand.items()) if (found := _of_hand(group)) is not None]


def of_one_version(pairs: Iterable[tuple[Path | None, PairGrasps]]) -> Iterator[PairGrasps]:
    """The pairs as they come, each with its data set, for messages; each name must stand for one hand in all of them."""
    known: dict[str, tuple[Path | None, PairGrasps]] = {}
    for path, pair in pairs:
        new, old = pair.grasps, known.setdefault(pair.grasps.hand, (path, pair))
        if (new.hand_sha256, new.joint_names) != (old[1].grasps.hand_sha256, old[1].grasps.joint_names):
            (place, hand), (old_place, old_hand) = _told(path, pair), _told(*old)
            raise GraspFileError(f"{place} are of a hand '{new.hand}' ({hand}), not that of {old_place} ({old_hand}): another "
                                 "hand of this name, or another version of it. Rename one file and make its grasps again, or "
                                 "handle them apart")
        yield pair


def _told(path: Path | None, pair: PairGrasps) -> tuple[str, str]:
    """Where grasps are, and which hand's: its file or name, with its hash."""
    grasps = pair.grasps
    file = next((file for file in grasps.extra.get(HAND_FILE, ()) if file), pair.hand)
    place = f"the grasps on {pair.object}" if path is None else f"the grasps on {pair.object} in {path}"
    return place, f"{file}, hash {grasps.hand_sha256[:12] or 'unknown'}"


def _of_hand(pairs: list[PairGrasps]) -> HandCoverage | None:
    grasps = GraspBatch.concatenate([p.grasps for p in pairs])
    try:
        hand = hand_of(next((p.grasps for p in pairs if len(p.grasps)), grasps), None)
    except HandError:
        if len(grasps):
            raise
        return None
    parts = tuple(_of_pair(hand, pair) for pair in sorted(pairs, key=lambda p: p.object))
    return HandCoverage(hand, grasps, parts, diversity(grasps.T_object_wrist, grasps.joints))


def _of_pair(hand: Hand, pair: PairGrasps) -> PairCoverage:
    grasps = pair.grasps
    counts = torch.bincount(half_axis(hand.palm_directions(grasps.T_object_wrist)), minlength=6)
    sector = (wrist_rolls(hand, grasps) / (2 * math.pi) * ROLL_BINS).long() % ROLL_BINS
    sizes = grasp_sizes(hand, grasps)
    touched = [len(links) for links in grasps.extra.get(CONTACT_LINKS, ()) if isinstance(links, list)]
    return PairCoverage(
        grasps.object[0] if len(grasps) else pair.object, len(grasps), pair.made, tuple(counts.tolist()), len(sector.unique()),
        (float(sizes.min()), float(sizes.max())) if len(grasps) else (math.nan, math.nan),
        (min(touched, default=0), max(touched, default=0)),
    )


def wrist_rolls(hand: Hand, grasps: GraspBatch) -> Float[Tensor, " n"]:
    """Roll of each wrist about its palm direction, from 0 to 2 pi [rad].

    Zero roll is the smallest rotation from the palm direction in the wrist frame to the palm direction of the grasp.
    """
    start, now = hand.palm_direction_wrist, hand.palm_directions(grasps.T_object_wrist)
    side = torch.linalg.cross(start, start.new_tensor([1.0, 0, 0] if abs(start[0]) < 0.9 else [0, 1.0, 0]), dim=0)
    side = side / side.norm()
    axis = torch.linalg.cross(start.expand_as(now), now, dim=-1)
    cosine = (start * now).sum(-1, keepdim=True)
    # Rodrigues' formula; the axis holds the sine. Opposite directions have no smallest rotation, and any of them will do.
    cross = torch.linalg.cross(axis, side.expand_as(axis), dim=-1)
    carried = cosine * side + cross + axis * (axis * side).sum(-1, keepdim=True) / (1 + cosine).clamp_min(1e-6)
    actual = grasps.T_object_wrist[:, :3, :3] @ side
    sine = (torch.linalg.cross(carried, actual, dim=-1) * now).sum(-1)
    return torch.atan2(sine, (carried * actual).sum(-1)) % (2 * math.pi)


def grasp_sizes(hand: Hand, grasps: GraspBatch) -> Float[Tensor, " n"]:
    """Largest distance between two fingertips of each grasp [m]: small for a pinch, large for a span."""
    if not len(grasps):
        return torch.zeros(0)
    tips = torch.tensor(hand.tips)
    points = se3.apply(hand.tree.forward(grasps.joints)[:, tips], hand.tip_offsets)
    return torch.cdist(points, points).amax((-1, -2))
