"""Collections of grasps of many pairs: a folder of shards, a folder of files, or one file."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dro_grasp._version import __version__
from dro_grasp.errors import GraspFileError, OptionError
from dro_grasp.files import given_path
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.grasp_file import read_footer
from dro_grasp.grasps.sources import hand_of, object_of, pair_keys, recorded_mass, require_same
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import checked
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.scene import require_simulable
from dro_grasp.training.data.engine.shards import Yield, find_shards, read_yield

YIELDS = "yields"  # Entry of a file's notes with the yield of each of its objects


@dataclass(frozen=True)
class PairGrasps:
    """The grasps of one hand on one object."""

    hand: str  # name of the hand, or the path under which it was requested
    object: str  # likewise; numbered where a file has several objects of the name (see `GraspBatch.by_object`)
    grasps: GraspBatch  # may be empty
    made: Yield
    """Yield of their production. A merged file may hold a choice of the valid grasps; for grasps from elsewhere only
    `valid` is known."""


class Sources:
    """Hands and objects of grasps, each loaded once."""

    def __init__(self) -> None:
        self.hands: dict[Any, Hand] = {}
        self.objects: dict[Any, ObjectModel] = {}

    def of(self, grasps: GraspBatch) -> tuple[Hand, ObjectModel]:
        """Those of grasps of one pair; the hashes that the grasps state are checked."""
        whose, of = pair_keys(grasps)
        hand = self.hands[whose] = self.hands.get(whose) or hand_of(grasps, None)
        heavy = *of, recorded_mass(grasps)
        obj = self.objects[heavy] = self.objects.get(heavy) or object_of(grasps, None, 1.0)
        require_same(grasps, hand, obj)
        return hand, obj


def sound_sources(parts: Iterable[GraspBatch]) -> list[tuple[Hand, ObjectModel]]:
    """Hand and object of each, found before the first trial: none is lost to a file that has changed, or to a bare cloud."""
    sources = Sources()
    pairs = [sources.of(grasps) for grasps in parts]
    for pair in pairs:
        require_simulable(*pair)
    return pairs


def yield_notes(yields: Mapping[str, Yield]) -> dict[str, Any]:
    """Notes of a file's header with the yield of each of its objects."""
    return {YIELDS: {name: made.to_dict() for name, made in yields.items()}, "version": __version__}


@checked
def read_collection(path: Path | str, only_successful: bool = True) -> Iterator[PairGrasps]:
    """The grasps of each pair, one pair after the other.

    Args:
        path: A folder that `synthesize` filled, a folder of grasp files, or one grasp file.
        only_successful: Leave out grasps that failed their trial or have none.

    Raises:
        GraspFileError: The path holds no grasps, or a file is damaged.
    """
    path = given_path(path)
    if path.is_file():
        pairs = _pairs_of_file(path)
    elif path.is_dir() and (files := sorted(path.glob("*.parquet"))):
        pairs = (pair for file in files for pair in _pairs_of_file(file))
    elif path.is_dir() and find_shards(path):
        pairs = _pairs_of_shards(path)
    else:
        raise GraspFileError(f"no grasps at {path}: expected a .parquet file, a folder of them, or a folder that "
                             "`dro-grasp synthesize` filled")
    empty = True
    for pair in pairs:
        empty = False
        yield replace(pair, grasps=pair.grasps[pair.grasps.trial_success]) if only_successful else pair
    if empty:
        raise GraspFileError(f"{path} holds no grasp; leave it out, or generate again without only_successful=True")


def require_apart(inputs: Sequence[Path | str], output: Path | str) -> None:
    """Refuse an output folder that is a data set, or in which one is a file: OptionError."""
    for path in map(given_path, inputs):
        if given_path(output).resolve() in (path.resolve(), *[path.resolve().parent] * path.is_file()):
            raise OptionError(f"{path} would be replaced by, or mixed with, what is made of it; write into another folder "
                              "(output=...)")


def count_collection(path: Path | str) -> dict[str, dict[str, int]]:
    """Number of grasps by hand and object; shards are counted by their footers alone."""
    path = given_path(path)
    if path.is_dir() and (shards := find_shards(path)):
        found = ((shard.hand, shard.object, read_yield(path, shard).valid) for shard in shards)
    else:
        found = ((pair.hand, pair.object, len(pair.grasps)) for pair in read_collection(path, only_successful=False))
    counts: dict[str, dict[str, int]] = {}
    for hand, obj, number in found:
        of_hand = counts.setdefault(hand, {})
        of_hand[obj] = of_hand.get(obj, 0) + number
    return counts


def _pairs_of_file(path: Path) -> Iterator[PairGrasps]:
    grasps = GraspBatch.load(path)
    yields = (read_footer(path)[1].get("notes") or {}).get(YIELDS) or {}
    if not isinstance(yields, dict):
        raise GraspFileError(f"{path}: the notes' '{YIELDS}' are {str(yields)[:60]}, expected an object; write the file again")
    parts = dict(grasps.by_object())
    for obj in dict.fromkeys((*parts, *yields)):
        part = parts.get(obj, grasps[[]])
        made = Yield.from_dict(yields[obj]) if obj in yields else Yield(valid=len(part))
        yield PairGrasps(grasps.hand, obj, part, made)


def _pairs_of_shards(folder: Path) -> Iterator[PairGrasps]:
    for (hand, obj), shards in itertools.groupby(find_shards(folder), lambda shard: (shard.hand, shard.object)):
        own = list(shards)
        batches = [GraspBatch.load(shard.path(folder)) for shard in own]
        hands = {batch.hand_sha256 for batch in batches}
        if len(hands) > 1 or len({sha for batch in batches for sha in batch.object_sha256}) > 1:
            what = f"hand '{hand}'" if len(hands) > 1 else f"object '{obj}'"
            raise GraspFileError(f"the shards of {hand} on {obj} were made with different versions of {what}, whose file has "
                                 "changed; synthesize the pair again into another folder")
        yield PairGrasps(hand, obj, GraspBatch.concatenate(batches), sum((read_yield(folder, s) for s in own), Yield()))
