"""Merge data sets: near-duplicates once, an even choice of grasps for each pair, one compact file for each hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dro_grasp._version import __version__
from dro_grasp.datasets.collections.collection import YIELDS, PairGrasps, read_collection
from dro_grasp.datasets.engine.shards import Yield
from dro_grasp.errors import GraspFileError
from dro_grasp.geometry.rotations import roma
from dro_grasp.geometry.se3 import compose
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.duplicates import distinct
from dro_grasp.grasps.sources import hand_of
from dro_grasp.hands.hand import Hand

POSITION_STEP = 2.0**-16
"""Grid of positions in merged files [m]. Ours: 0.015 mm."""
ANGLE_STEP = 2.0**-13
"""Grid of joints in merged files [rad or m]. Ours: 0.12 mrad."""
UNIT_STEP = 2.0**-15
"""Grid of quaternions in merged files. Ours: 0.03 mrad."""
MANTISSA = 10
"""Bits of the mantissa of all other numbers in merged files. Ours: three digits."""
PLAIN_COLUMNS = ("reason", "failure")
"""Columns that are empty for successes."""


@dataclass(frozen=True)
class Merged:
    """One hand's grasps out of several data sets."""

    hand: str
    grasps: GraspBatch
    yields: dict[str, Yield]
    """By object."""
    duplicates: int
    """Near-duplicates that were dropped."""
    surplus: int
    """Grasps above the number asked for, dropped."""

    def save(self, path: Path) -> None:
        """Write one grasp file with the yields in its notes.

        Raises:
            OutputError: The path cannot be written.
        """
        yields = {name: made.to_dict() for name, made in self.yields.items()}
        self.grasps.save(path, {YIELDS: yields, "version": __version__})


def merge(paths: Sequence[Path | str], per_pair: int | None = None) -> list[Merged]:
    """Merge data sets, hand by hand.

    Args:
        paths: As in `read_collection`.
        per_pair: Most grasps of a pair; the choice spreads best over palm directions.

    Raises:
        GraspFileError: A path holds no grasps, or data sets know different versions of a hand or object.
        HandError: A hand cannot be loaded.
    """
    by_hand: dict[str, dict[str, list[PairGrasps]]] = {}
    for path in paths:
        for pair in read_collection(path):
            # The pair may have been requested by path.
            name = pair.grasps.object[0] if len(pair.grasps) else pair.object
            by_hand.setdefault(pair.grasps.hand, {}).setdefault(name, []).append(pair)
    return [_merge_hand(hand, pairs, per_pair) for hand, pairs in sorted(by_hand.items())]


def file_name(hand: str) -> str:
    """Name of a merged file: the hand's with its source, as hands of two sources may share a name."""
    return f"{hand.replace('/', '-')}.parquet"


def _merge_hand(name: str, pairs: dict[str, list[PairGrasps]], per_pair: int | None) -> Merged:
    hashes = {p.grasps.hand_sha256 for group in pairs.values() for p in group}
    if len(hashes) > 1:
        raise GraspFileError(f"the data sets were made with different versions of hand '{name}'; merge them apart")
    first = next(iter(pairs.values()))[0].grasps
    hand = hand_of(first, None)
    kept, yields, duplicates, surplus = [], {}, 0, 0
    for obj, group in sorted(pairs.items()):
        objects = {sha for p in group for sha in p.grasps.object_sha256}
        if len(objects) > 1:
            raise GraspFileError(f"the data sets were made with different versions of object '{obj}'; merge them apart")
        grasps = GraspBatch.concatenate([p.grasps for p in group])
        new = grasps[distinct(hand, grasps)] if len(group) > 1 else grasps
        chosen = new if per_pair is None else new[spread(hand, new, per_pair)]
        yields[obj] = sum((p.made for p in group), Yield())
        duplicates, surplus = duplicates + len(grasps) - len(new), surplus + len(new) - len(chosen)
        kept.append(compact(hand, chosen))
    return Merged(name, GraspBatch.concatenate(kept), yields, duplicates, surplus)


def spread(hand: Hand, grasps: GraspBatch, count: int) -> Int[Tensor, " k"]:
    """Indices of at most `count` grasps whose palm directions cover the sphere best, in their order.

    Farthest-first: the choice starts with the first grasp and adds the one whose palm direction is farthest from all
    chosen ones.
    """
    if len(grasps) <= count:
        return torch.arange(len(grasps))
    directions = hand.palm_directions(grasps.T_object_wrist)
    chosen = [0]
    nearest = 1 - directions @ directions[0]
    for _ in range(count - 1):
        nearest[chosen[-1]] = -1.0
        chosen.append(int(nearest.argmax()))
        nearest = torch.minimum(nearest, 1 - directions @ directions[chosen[-1]])
    return torch.tensor(sorted(chosen))


def compact(hand: Hand, grasps: GraspBatch) -> GraspBatch:
    """The grasps with rounded numbers, so that files compress; joints stay within their limits."""
    quaternion = _on_grid(roma.rotmat_to_unitquat(grasps.T_object_wrist[:, :3, :3]), UNIT_STEP)
    rotation = roma.unitquat_to_rotmat(quaternion / quaternion.norm(dim=-1, keepdim=True))
    T = compose(rotation, _on_grid(grasps.T_object_wrist[:, :3, 3], POSITION_STEP))
    joints = _on_grid(grasps.joints, ANGLE_STEP)
    joints = torch.minimum(torch.maximum(joints, hand.tree.lower), hand.tree.upper)
    extra = {
        name: _short(value) if isinstance(value, Tensor) and value.is_floating_point() else value
        for name, value in grasps.extra.items() if name not in PLAIN_COLUMNS
    }
    numbers = {name: getattr(grasps, name) for name in ("score", "energy", "displacement", "rotation", "penetration")}
    short = {name: _short(value) for name, value in numbers.items()}
    return grasps.replace(T_object_wrist=T, joints=joints, extra=extra, **short)


def _on_grid(values: Float[Tensor, "*n"], step: float) -> Float[Tensor, "*n"]:
    return (values / step).round() * step


def _short(values: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Values with MANTISSA bits."""
    mantissa, exponent = torch.frexp(values)
    return torch.ldexp((mantissa * 2**MANTISSA).round() / 2**MANTISSA, exponent)
