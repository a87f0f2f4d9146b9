"""A folder of grasp shards: one Parquet file for each (hand, object, round), there whole or not at all.

The folder is the state of a data set's making: what is there is done, everything else is still to do.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote, unquote

from dro_grasp.errors import GraspFileError, OutputError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.table import read_row_count

STALE = 3600.0
"""Age after which a temporary file is taken as left behind by a killed process [s]."""


@dataclass(frozen=True, order=True)
class Shard:
    """One unit of work and the file that holds its result."""

    hand: str
    """Name of the hand."""
    object: str
    """Name of the object."""
    round: int
    """Counts up from 0 for each pair."""

    def path(self, folder: Path) -> Path:
        """Where the shard's file lies in a data set's folder."""
        return folder / quote(self.hand, safe="") / quote(self.object, safe="+") / f"{self.round:05d}.parquet"

    def save(self, grasps: GraspBatch, folder: Path) -> None:
        """Write the shard's file; it appears whole or not at all.

        Raises:
            OutputError: The folder cannot be written.
        """
        path = self.path(folder)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"cannot make {path.parent}: {error.strerror}") from error
        grasps.save(path)


def find_shards(folder: Path | str) -> list[Shard]:
    """All finished shards of a data set's folder, sorted.

    Raises:
        GraspFileError: There is no such folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise GraspFileError(f"no folder {folder}; give the folder that `dro-grasp synthesize` wrote")
    shards = []
    for path in folder.glob("*/*/*.parquet"):
        if re.fullmatch(r"\d+", path.stem):
            shards.append(Shard(unquote(path.parts[-3]), unquote(path.parts[-2]), int(path.stem)))
    return sorted(shards)


def count_grasps(folder: Path, shard: Shard) -> int | None:
    """Number of grasps in a shard, from the file's footer; None when the file cannot be read."""
    try:
        return read_row_count(shard.path(folder))
    except GraspFileError:
        return None


def read_pairs(
    folder: Path | str, hands: Sequence[str] | None = None, only_successful: bool = True
) -> Iterator[tuple[tuple[str, str], GraspBatch]]:
    """The grasps of each (hand, object) pair of a data set, one pair after the other.

    Args:
        folder: The data set's folder.
        hands: Only these hands; None for all.
        only_successful: Leave out grasps that failed their trial or had none.

    Raises:
        GraspFileError: There is no such folder, or a shard is damaged.
    """
    folder = Path(folder)
    pairs: dict[tuple[str, str], list[Shard]] = {}
    for shard in find_shards(folder):
        if hands is None or shard.hand in hands:
            pairs.setdefault((shard.hand, shard.object), []).append(shard)
    for pair, shards in pairs.items():
        batches = [GraspBatch.load(shard.path(folder)) for shard in shards]
        grasps = GraspBatch.concatenate(batches)
        if only_successful:
            grasps = grasps[grasps.success & grasps.tried] if grasps.success is not None else grasps[0:0]
        if len(grasps):
            yield pair, grasps


def remove_leftovers(folder: Path) -> int:
    """Remove temporary files that killed processes left behind; returns how many."""
    old = [p for p in folder.glob("*/*/.*.part") if time.time() - p.stat().st_mtime > STALE]
    for path in old:
        path.unlink(missing_ok=True)
    return len(old)
