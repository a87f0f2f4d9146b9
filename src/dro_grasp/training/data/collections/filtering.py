"""Filter a data set: the grasps that pass all of some protocols, settled again before if asked, pair by pair.

A pair that is done is a file. Killing a run at any time loses at most the pairs in flight; a rerun makes only what is missing.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any

import torch

from dro_grasp.errors import GraspFileError, OptionError
from dro_grasp.files import is_unread, make_folder, set_aside
from dro_grasp.grasps.batch import GraspBatch, distinct
from dro_grasp.grasps.grasp_file import read_footer
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import Checked, checked, require_positive
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.stages import refine
from dro_grasp.simulation.outcome import FEWEST_LINKS
from dro_grasp.simulation.protocols import Protocol
from dro_grasp.simulation.trial import simulate
from dro_grasp.training.data.collections.collection import PairGrasps, Sources, sound_sources, yield_notes
from dro_grasp.training.data.collections.merging import file_name
from dro_grasp.training.data.engine.labels import RESTLESS, also_passing, at_rest, closed_where_they_hold
from dro_grasp.training.data.engine.pools import LocalPool, attempt
from dro_grasp.training.data.engine.schedule import COMMAND, REPORT_EVERY, SETTINGS, agree
from dro_grasp.training.data.engine.shards import Failed, Shard, Yield, find_shards, notes_of, remove_leftovers, sole_run
from dro_grasp.training.data.engine.worker import LOOSE, FinishedShard

FILTER = "filter"  # Entry of a file's notes, and value of the setting COMMAND
ROW = "row"  # Further column, while a pair is filtered: which row of it a grasp was
DUPLICATE = "near-duplicate once settled"  # Reason that counts grasps that come to rest where an earlier one does
ORDER = 0  # Seed of the order of the pairs: any part of a run is a fair sample of the whole (ours)
ATTEMPTS = 2  # A pair is given up after so many deaths of its worker (ours)
PAIR_SECONDS = 3600.0  # A pair that takes longer is stopped, as if its worker had died [s] (ours)


@dataclass(frozen=True)
class FilterConfig(Checked):
    """What grasps must do to stay."""

    protocols: tuple[Protocol, ...]
    """Protocols that they must pass, all of them; put the one that fails most first, as only what passes is tried on."""
    resettle: bool = False
    """Settle them as `generate` does before; what does not come to rest is left out."""
    again: bool = False
    """Refine those that fail, settle them once more, and keep what then passes."""
    close_fingers: bool = False
    """Close idle fingers onto the object: before settling, or where the grasp then passes the first protocol as well."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.protocols:
            raise OptionError("no protocol is given; name one at least that grasps must pass")
        if self.again and not self.resettle:
            raise OptionError("grasps that fail are made again by settling them; ask for that too (resettle=True)")

    @property
    def settings(self) -> dict[str, Any]:
        """Plain values by name."""
        return {COMMAND: FILTER, "protocols": [rules.label for rules in self.protocols], "resettle": self.resettle,
                "again": self.again, "close_fingers": self.close_fingers}


@dataclass(frozen=True)
class FilterTask:
    """One pair to filter."""

    shard: Shard  # its round counts the data sets that have the pair
    grasps: bytes  # a grasp file
    made: Yield
    fingerprint: str


@dataclass(frozen=True)
class Kept:
    """What is left of a pair."""

    hand: str
    object: str
    grasps: int  # evaluated
    kept: int
    failures: dict[str, int]  # why the others are left out, counted
    remade: int = 0  # of those kept, how many failed at first


@dataclass(frozen=True)
class FilterReport:
    """Result of one run."""

    pairs: tuple[Kept, ...]  # those that are done, in the order of the data sets
    given_up: dict[tuple[str, str], str]  # pairs that could not be filtered, and why


def passing(hand: Hand, obj: ObjectModel, grasps: GraspBatch, config: FilterConfig) -> tuple[GraspBatch, Counter[str], int]:
    """The grasps of one pair that pass, why the others do not, and how many of those that pass were made again.

    `again` appends; near-duplicates that settling makes are dropped.
    """
    passed, failed, failures = _passing(hand, obj, grasps, config)
    if not config.resettle:
        return passed, failures, 0
    remade = passed[:0]
    if config.again and len(failed):
        refined = refine(GraspProblem(hand, obj), failed)
        posed = failed.with_poses(refined.T_object_wrist, refined.joints).replace(energy=failed.energy)
        posed = posed.replace(pregrasp_joints=refined.pregrasp_joints, squeeze_joints=refined.squeeze_joints)
        remade, _, failures = _passing(hand, obj, posed, replace(config, close_fingers=False))
    both = GraspBatch.concatenate([passed, remade])
    new = distinct(hand, both)
    return both[new], failures + Counter({DUPLICATE: int((~new).sum())}), int(new[len(passed):].sum())


def _passing(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, config: FilterConfig
) -> tuple[GraspBatch, GraspBatch, Counter[str]]:
    """Grasps that pass, those that do not, as they were, and why not."""
    first, *further = config.protocols
    rows, given, failures = torch.arange(len(grasps)), grasps, Counter[str]()
    if config.resettle:
        (grasps, stable), = at_rest(hand, [obj], [grasps], config.close_fingers)
        rows, failures = stable.nonzero()[:, 0], Counter({RESTLESS: int((~stable).sum())})
    trial = simulate(hand, obj, grasps[rows], first)
    evaluated = grasps[rows].with_trial(trial)
    if config.close_fingers and not config.resettle:
        evaluated, = closed_where_they_hold(hand, [obj], [evaluated], first)
    failures.update(f.value for f, held in zip(trial.failure, evaluated.success.tolist(), strict=True) if f and not held)
    held = evaluated.success
    if config.resettle:  # labels are what `synthesize` makes: a cage of one link is none
        loose = held & (trial.contacts < FEWEST_LINKS)
        held, failures = held & ~loose, failures + Counter({LOOSE: int(loose.sum())})
    marked = evaluated[held]
    marked = marked.replace(extra=marked.extra | {ROW: rows[held]})
    (passed, later), = also_passing(hand, [obj], [marked], further)
    failed = torch.ones(len(given), dtype=torch.bool)
    failed[passed.extra[ROW]] = False
    passed = passed.replace(extra={name: column for name, column in passed.extra.items() if name != ROW})
    return passed, given[failed], failures + later


_sources = lru_cache(maxsize=1)(Sources)  # Hands and objects of a process


def filter_pair(config: FilterConfig, task: FilterTask) -> FinishedShard:
    """Filter one pair; it takes and gives bytes, so that it runs in any process."""
    grasps = GraspBatch.load(BytesIO(task.grasps))
    kept, failures, remade = passing(*_sources().of(grasps), grasps, config) if len(grasps) else (grasps, Counter[str](), 0)
    tally = {"input": task.fingerprint, "grasps": len(grasps), "failures": dict(failures), "remade": remade}
    return FinishedShard(task.shard, kept.to_bytes(notes_of(task.made) | {FILTER: tally}), task.made)


@checked
def filter_dataset(
    pairs: Iterable[PairGrasps], output: Path | str, config: FilterConfig, workers: int = 1,
    progress: Callable[[int, int], None] | None = None, say: Callable[[str], None] | None = None,
) -> FilterReport:
    """Fill a folder with what passes of data sets: a file for each pair as it is done, and at the end one for each hand.

    Pairs are visited in random order, the same in every run, so what is there before the end is a fair sample.

    Args:
        pairs: The data sets.
        output: The folder; made when missing. It may hold what an earlier run with the same settings left.
        config: What grasps must do to stay.
        workers: Processes of one thread each; 1 works in this process, with all cores in trials.
        progress: Called with (grasps done, grasps in all).
        say: Called with a line of text about files that are set aside.

    Raises:
        OptionError: A number is not positive, or the folder was begun with other settings or by another command.
        GraspFileError: A hand or an object has changed since.
        ObjectError: An object is a bare cloud.
        OutputError: The folder cannot be made or written, or another run is filling it.
    """
    require_positive(workers=workers)
    given = list(pairs)
    sound_sources(pair.grasps for pair in given if len(pair.grasps))
    folder = make_folder(output)
    tasks = _tasks(given)
    with sole_run(folder, mergeable=True):
        _begin(folder, config)
        remove_leftovers(folder)
        missing = [task for task in tasks if not _done(folder, task, say or (lambda line: None))]
        if missing:
            _part(folder, given)
        given_up: dict[tuple[str, str], str] = {}
        sizes = {task.shard: len(pair.grasps) for task, pair in zip(tasks, given, strict=True)}
        done = sum(sizes.values()) - sum(sizes[task.shard] for task in missing)
        random.Random(ORDER).shuffle(missing)
        for task, result in _results(missing, config, workers):
            if isinstance(result, Failed):
                given_up[task.shard.hand, task.shard.object] = result.reason
            else:
                task.shard.save(result.payload, folder)
            done += sizes[task.shard]
            if progress is not None:
                progress(done, sum(sizes.values()))
        whole = [task.shard for task in tasks if (task.shard.hand, task.shard.object) not in given_up]
        _join(folder, whole)
        return FilterReport(tuple(read_kept(folder, shard) for shard in whole), given_up)


def _begin(folder: Path, config: FilterConfig) -> None:
    """Refuse a folder with grasps of another command, or of other settings."""
    if not (folder / SETTINGS).exists() and (find_shards(folder) or any(folder.glob("*.parquet"))):
        raise OptionError(f"{folder} holds grasps of another command; give a folder of its own to what passes (output=...)")
    agree(folder, config.settings)


def _tasks(pairs: Sequence[PairGrasps]) -> list[FilterTask]:
    seen: Counter[tuple[str, str]] = Counter()
    tasks = []
    for pair in pairs:
        shard = Shard(pair.hand, pair.object, seen[pair.hand, pair.object])
        seen[pair.hand, pair.object] += 1
        tasks.append(FilterTask(shard, pair.grasps.to_bytes(), pair.made, _fingerprint(pair.grasps)))
    return tasks


def _fingerprint(grasps: GraspBatch) -> str:
    """What tells a pair's grasps from others, whatever wrote their file."""
    digest = sha256(repr((grasps.hand_sha256, grasps.joint_names, grasps.object, grasps.object_sha256)).encode())
    for column in (grasps.T_object_wrist, grasps.joints, grasps.pregrasp_joints, grasps.squeeze_joints):
        digest.update(column.nan_to_num(nan=torch.inf).contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def _done(folder: Path, task: FilterTask, say: Callable[[str], None]) -> bool:
    """Whether an earlier run has filtered these grasps; a damaged file is named and set aside."""
    path = task.shard.path(folder)
    if not path.exists():
        return False
    try:
        GraspBatch.load(path)
        return bool(_tally(path)["input"] == task.fingerprint)
    except GraspFileError as error:
        if is_unread(error):
            raise
        say(f"{error}; it is set aside as {set_aside(path).name} and made again")
        return False


def _tally(path: Path) -> dict[str, Any]:
    """What a pair's file notes of its filtering."""
    found = (read_footer(path)[1].get("notes") or {}).get(FILTER)
    if not isinstance(found, dict) or "input" not in found:
        raise GraspFileError(f"{path} was not written by `dro-grasp dataset filter`")
    return found


def read_kept(folder: Path, shard: Shard) -> Kept:
    """What is left of a pair, from its file's footer; GraspFileError: `filter_dataset` did not write it."""
    tally, (rows, _) = _tally(shard.path(folder)), read_footer(shard.path(folder))
    return Kept(shard.hand, shard.object, tally["grasps"], rows, tally["failures"], tally["remade"])


def _results(
    tasks: Sequence[FilterTask], config: FilterConfig, workers: int
) -> Iterator[tuple[FilterTask, FinishedShard | Failed]]:
    """Each pair with what became of it, as it is done."""
    if workers == 1:
        for task in tasks:
            yield task, attempt(filter_pair, config, task)
        return
    waiting, deaths, flying = list(reversed(tasks)), Counter[Shard](), 0
    pool = LocalPool(config, workers, PAIR_SECONDS, filter_pair)
    try:
        while waiting or flying:
            while waiting and pool.free:
                pool.submit(waiting.pop())
                flying += 1
            for task, result in pool.wait(REPORT_EVERY):
                flying -= 1
                died = isinstance(result, Failed) and result.died
                deaths[task.shard] += died
                if died and deaths[task.shard] < ATTEMPTS:
                    waiting.append(task)
                else:
                    yield task, result
    finally:
        pool.close()


def _part(folder: Path, given: Sequence[PairGrasps]) -> None:
    """Remove the files that an earlier run joined: beside them, what is added before the end would not be read."""
    for hand in {pair.grasps.hand for pair in given} | {shard.hand for shard in find_shards(folder)}:
        (folder / file_name(hand)).unlink(missing_ok=True)


def _join(folder: Path, shards: Sequence[Shard]) -> None:
    """Write one file for each hand, of all its pairs."""
    by_hand: dict[str, list[tuple[Shard, GraspBatch]]] = {}
    for shard in shards:
        grasps = GraspBatch.load(shard.path(folder))
        by_hand.setdefault(grasps.hand, []).append((shard, grasps))
    for hand, own in by_hand.items():
        yields: dict[str, Yield] = {}
        for shard, _ in own:
            made = Yield.from_dict(read_footer(shard.path(folder))[1]["notes"]["yield"])
            yields[shard.object] = yields.get(shard.object, Yield()) + made
        GraspBatch.concatenate([grasps for _, grasps in own]).save(folder / file_name(hand), yield_notes(yields))
