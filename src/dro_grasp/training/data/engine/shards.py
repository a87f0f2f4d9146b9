"""A folder of grasp shards: one Parquet file for each (hand, object, round), there whole or not at all, with its yield.

The folder is the state of the production: a shard that is there is done, every other one is still to do.
"""

from __future__ import annotations

import dataclasses
import os
import re
import socket
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

from dro_grasp._version import __version__
from dro_grasp.errors import DroGraspError, GraspFileError, OutputError
from dro_grasp.files import locking, make_folder, replacing
from dro_grasp.grasps.grasp_file import read_footer

LOCK = ".lock"
"""File in a data set's folder that a run locks while it fills the folder; one for each part of a run that is divided."""
HOLDER = ".process"
"""File with the number of the process that holds the lock; other systems than Linux let nobody read a locked file."""
MAX_YIELD = 1e18  # More than any count or time of a yield (ours)
STALE = 3600.0  # Age from which a temporary file counts as left behind by a killed process [s]. Ours


@dataclass(frozen=True)
class Yield:
    """Where the candidates of a shard, a pair or a data set end up.

    Each is in exactly one of `ranked_out`, `deep`, `moved`, `failures`, `duplicates` and `valid`.
    """

    candidates: int = 0  # grasps synthesized
    ranked_out: int = 0  # without a trial because their energy was too high
    deep: int = 0  # without a trial because they penetrate the object too far
    moved: int = 0  # without a trial because closing moved the object too far
    failures: dict[str, int] = field(default_factory=dict)  # failed trials by reason
    duplicates: int = 0  # passed, but near-duplicates of an earlier grasp
    valid: int = 0  # passed and stored
    judged: int = 0  # of what passed on a device, tried again by the processor; what it refutes is among the failures
    judging_seconds: float = 0.0  # how long the processor took for that [s]
    cpu_seconds: float = 0.0  # CPU time without loading hand and object [s]
    preparation_seconds: float = 0.0
    """CPU time of loading hand and object, with convex parts and grid where they are not cached [s]."""

    @property
    def evaluated(self) -> int:
        """Number of trials."""
        return sum(self.failures.values()) + self.duplicates + self.valid

    @property
    def per_cpu_hour(self) -> float:
        """Valid grasps per hour of one core; 0 without any time."""
        return 3600 * self.valid / self.cpu_seconds if self.cpu_seconds > 0 else 0.0

    def __add__(self, other: Yield) -> Yield:
        names = [f.name for f in dataclasses.fields(self) if f.name != "failures"]
        sums = {name: getattr(self, name) + getattr(other, name) for name in names}
        return Yield(**sums, failures=dict(Counter(self.failures) + Counter(other.failures)))

    def main_obstacle(self) -> str:
        """Where most of the tested candidates were lost, in words."""
        lost = self.failures | {
            "hand too deep in the object": self.deep, "closing moves the object too far": self.moved,
        }
        reason = max(lost, key=lambda name: lost[name], default="")
        share = lost[reason] / max(1, self.evaluated + self.deep + self.moved) if reason else 0.0
        return f"{reason} ({share:.0%} of the tested candidates)" if share else "no candidate was tested"

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_dict(values: Any) -> Yield:
        """The inverse of `to_dict`, whose entries must be counts and times; those of other versions are ignored."""
        known = {f.name for f in dataclasses.fields(Yield)}
        given: dict[str, Any] = values if isinstance(values, dict) else {"valid": [values]}
        own = {name: value for name, value in given.items() if name in known}
        failures = own.get("failures", {})
        counts = [value for name, value in own.items() if name != "failures"]
        counts += failures.values() if isinstance(failures, dict) else [failures]
        if wrong := [x for x in counts if not isinstance(x, int | float) or not 0 <= x < MAX_YIELD]:
            raise GraspFileError(f"the yields in a grasp file's notes hold {str(wrong[0])[:60]}; expected counts and seconds: "
                                 "write the file again")
        return Yield(**own)


@dataclass(frozen=True, order=True)
class Shard:
    """One unit of work and the file that holds its result."""

    hand: str
    object: str
    round: int  # counts up from 0 for each pair

    def path(self, folder: Path) -> Path:
        """Where the shard's file lies in a data set's folder."""
        return folder / quote(self.hand, safe="") / quote(self.object, safe="+") / f"{self.round:05d}.parquet"

    def save(self, payload: bytes, folder: Path) -> None:
        """Write the shard's file; it appears whole or not at all."""
        try:
            make_folder(self.path(folder).parent)
            with replacing(self.path(folder)) as temporary:
                temporary.write_bytes(payload)
        except OutputError as error:
            raise OutputError(f"{error}. The shards that are there are whole; in the same folder, the same command goes on "
                              "from them") from error


@dataclass(frozen=True)
class Failed:
    """A shard that could not be made."""

    reason: str  # in one line
    died: bool = False  # the worker died or was stopped: a new attempt may succeed


def failure_of(error: BaseException) -> Failed:
    """An error of one shard in one line."""
    reason = str(error) if isinstance(error, DroGraspError) else f"{type(error).__name__}: {error}"
    return Failed(reason.splitlines()[0][:300] if reason else type(error).__name__)


def notes_of(result: Yield) -> dict[str, Any]:
    """Notes on its production in a shard's header."""
    return {"yield": result.to_dict(), "version": __version__}


def find_shards(folder: Path | str) -> list[Shard]:
    """All finished shards of a data set's folder, sorted."""
    folder = Path(folder)
    if not folder.is_dir():
        raise GraspFileError(f"no folder {folder}; give the folder that `dro-grasp synthesize` wrote")
    try:
        paths = list(folder.glob("*/*/*.parquet"))
    except FileNotFoundError as error:
        raise GraspFileError(f"{error.filename} disappeared while {folder} was listed; wait for what removes files there, or "
                             f"give the folder that `dro-grasp synthesize` wrote") from error
    return sorted(Shard(unquote(path.parts[-3]), unquote(path.parts[-2]), int(path.stem))
                  for path in paths if re.fullmatch(r"\d+", path.stem))


def read_yield(folder: Path, shard: Shard) -> Yield:
    """Yield of a shard, from the file's footer; `valid` is the number of grasps it holds."""
    rows, header = read_footer(shard.path(folder))
    notes = header.get("notes") or {}
    return dataclasses.replace(Yield.from_dict(notes.get("yield") or {}), valid=rows)


@contextmanager
def sole_run(folder: Path, part: tuple[int, int] = (1, 1), mergeable: bool = False) -> Iterator[None]:
    """Keep a second run of the same part out of a folder while the block lasts, and runs that divide the work otherwise.

    OutputError: one is at work; of `mergeable` results it says how they join those of another folder.
    """
    suffix = "" if part[1] == 1 else f"-{part[0]}-of-{part[1]}"
    fellows = {f"{LOCK}-{i}-of-{part[1]}" for i in range(1, part[1] + 1)}
    holder = folder / f"{HOLDER}{suffix}"
    with _part_locked(folder, LOCK + suffix, mergeable):
        try:
            with suppress(OSError):  # on a full disk the first shard tells
                holder.write_text(f"{os.getpid()} on {socket.gethostname()}")
            for other in sorted({path.name for path in folder.glob(f"{LOCK}*")} - fellows - {LOCK + suffix}):
                with _part_locked(folder, other, mergeable):
                    pass
            yield
        finally:
            holder.unlink(missing_ok=True)


def _part_locked(folder: Path, name: str, mergeable: bool) -> AbstractContextManager[None]:
    """Hold the lock of a part of a folder, unless another run does."""
    def refuse() -> str:
        holder = folder / name.replace(LOCK, HOLDER)
        process = holder.read_text() if holder.exists() else "unknown"
        part = f" as part {name.removeprefix(LOCK + '-').replace('-of-', ' of ')}" if name != LOCK else ""
        join = " and join both with `dro-grasp dataset merge`" if mergeable else ""
        return f"another run is filling {folder}{part} (process {process}); wait for it, or give another folder{join}"

    return locking(folder / name, refuse)


def remove_leftovers(folder: Path) -> int:
    """Remove temporary files that killed processes left behind; returns how many."""
    removed = 0
    for path in [*folder.glob(".*.part"), *folder.glob("*/*/.*.part")]:
        with suppress(FileNotFoundError):  # another part of the run has renamed or removed it
            if time.time() - path.stat().st_mtime > STALE:
                path.unlink()
                removed += 1
    return removed
