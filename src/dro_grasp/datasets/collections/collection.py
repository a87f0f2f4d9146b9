"""Collections of grasps of many pairs: a folder of shards, a folder of files, or one file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from dro_grasp.datasets.engine.shards import find_shards, read_yield
from dro_grasp.datasets.engine.yields import Yield
from dro_grasp.errors import GraspFileError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.table import read_footer

YIELDS = "yields"
"""Entry of a file's notes with the yield of each of its objects."""


@dataclass(frozen=True)
class PairGrasps:
    """The grasps of one hand on one object."""

    hand: str
    """Name of the hand, or the path under which it was requested."""
    object: str
    """Likewise."""
    grasps: GraspBatch
    """May be empty."""
    made: Yield
    """Yield of their production. A merged file may hold a choice of the valid grasps; for grasps from elsewhere only
    `valid` is known."""


def read_collection(path: Path | str, only_successful: bool = True) -> Iterator[PairGrasps]:
    """The grasps of each pair, one pair after the other.

    Args:
        path: A folder that `synthesize` filled, a folder of grasp files, or one grasp file.
        only_successful: Leave out grasps that failed their trial or have none.

    Raises:
        GraspFileError: The path holds no grasps, or a file is damaged.
    """
    path = Path(path)
    if path.is_file():
        pairs = _pairs_of_file(path)
    elif path.is_dir() and (files := sorted(path.glob("*.parquet"))):
        pairs = (pair for file in files for pair in _pairs_of_file(file))
    elif path.is_dir() and find_shards(path):
        pairs = _pairs_of_shards(path)
    else:
        raise GraspFileError(f"no grasps at {path}: expected a .parquet file, a folder of them, or a folder that "
                             "`dro-grasp synthesize` filled")
    for pair in pairs:
        yield replace(pair, grasps=successful(pair.grasps)) if only_successful else pair


def count_collection(path: Path | str) -> dict[str, dict[str, int]]:
    """Number of grasps by hand and object; shards are counted by their footers alone.

    Raises:
        GraspFileError: As `read_collection`.
    """
    counts: dict[str, dict[str, int]] = {}
    path = Path(path)
    if path.is_dir() and (shards := find_shards(path)):
        for shard in shards:
            of_hand = counts.setdefault(shard.hand, {})
            of_hand[shard.object] = of_hand.get(shard.object, 0) + read_yield(path, shard).valid
        return counts
    for pair in read_collection(path, only_successful=False):
        counts.setdefault(pair.hand, {})[pair.object] = len(pair.grasps)
    return counts


def successful(grasps: GraspBatch) -> GraspBatch:
    """The grasps that passed their trial."""
    return grasps[grasps.success]


def _pairs_of_file(path: Path) -> Iterator[PairGrasps]:
    grasps = GraspBatch.load(path)
    yields = (read_footer(path)[1].get("notes") or {}).get(YIELDS) or {}
    parts = dict(grasps.by_object())
    for obj in dict.fromkeys((*parts, *yields)):
        part = parts.get(obj, grasps[[]])
        made = Yield.from_dict(yields[obj]) if obj in yields else Yield(valid=len(part))
        yield PairGrasps(grasps.hand, obj, part, made)


def _pairs_of_shards(folder: Path) -> Iterator[PairGrasps]:
    pairs: dict[tuple[str, str], list[int]] = {}
    shards = find_shards(folder)
    for i, shard in enumerate(shards):
        pairs.setdefault((shard.hand, shard.object), []).append(i)
    for (hand, obj), indices in pairs.items():
        own = [shards[i] for i in indices]
        grasps = GraspBatch.concatenate(_of_one_hand([GraspBatch.load(s.path(folder)) for s in own], hand, obj))
        yield PairGrasps(hand, obj, grasps, sum((read_yield(folder, s) for s in own), Yield()))


def _of_one_hand(batches: Sequence[GraspBatch], hand: str, obj: str) -> Sequence[GraspBatch]:
    """Refuse shards made with different versions of a hand or an object.

    Raises:
        GraspFileError: The versions differ.
    """
    hands = {b.hand_sha256 for b in batches}
    objects = {sha for b in batches for sha in b.object_sha256}
    if len(hands) > 1 or len(objects) > 1:
        what = f"hand '{hand}'" if len(hands) > 1 else f"object '{obj}'"
        raise GraspFileError(f"the shards of {hand} on {obj} were made with different versions of {what}, whose file has "
                             "changed; synthesise the pair again into another folder")
    return batches
