"""Fill a folder with grasps of many hands on many objects: independent shards, made here or on many machines.

Killing a run at any time loses at most the shards in flight; a rerun makes only what is missing.
"""

from __future__ import annotations

import heapq
import itertools
import json
import math
import os
import secrets
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from dro_grasp.devices import cores, on_accelerator, require_device
from dro_grasp.errors import GraspFileError, OptionError, OutputError
from dro_grasp.files import given_path, is_unread, make_folder, reading, set_aside
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.library import load_hand, locate_hand
from dro_grasp.kinds import checked, flat, require_positive
from dro_grasp.objects.catalogue import ASSET_PREFIX, load_object, locate_object, object_names
from dro_grasp.simulation.worlds import require_worlds
from dro_grasp.training.data.engine.pools import LocalPool, Outcome, Pool
from dro_grasp.training.data.engine.shards import Failed, Shard, Yield, find_shards, read_yield, remove_leftovers, sole_run
from dro_grasp.training.data.engine.worker import EngineConfig, FinishedShard, Job, Task

REPORT_EVERY = 10.0  # Time between lines of progress [s]. Ours
LONGEST_NAME = 255  # Longest name of a folder that file systems take [bytes]
CANDIDATE_STEP = 64  # Shards have a multiple of this many candidates. Ours
CANDIDATES_PER_GRASP = 8  # Candidates of a first shard for each grasp that is asked for, before a yield is known. Ours
Pair = tuple[str, str]
Content = TypeVar("Content")


@dataclass
class PairState:
    """Progress of one (hand, object) pair."""

    total: Yield = field(default_factory=Yield)
    done: set[int] = field(default_factory=set)  # finished rounds; damaged shards leave gaps
    barren: int = 0  # rounds without a grasp since the last one with a grasp
    crashes: int = 0  # deaths of workers on it since its last shard
    error: str = ""  # the error that ended it, empty without one

    @property
    def grasps(self) -> int:
        """Stored so far."""
        return self.total.valid

    def note(self, shard: Shard, made: Yield) -> None:
        """Record a finished shard."""
        self.done.add(shard.round)
        self.total = self.total + made
        self.barren = 0 if made.valid else self.barren + 1

    def next_candidates(self, goal: int, config: EngineConfig) -> int:
        """Size of the next shard: the missing grasps at the pair's yield so far, within the config's bounds."""
        if self.total.candidates and not self.grasps:
            return config.candidates
        each, most = CANDIDATES_PER_GRASP, config.candidates
        if self.grasps:
            each, most = self.total.candidates / self.grasps, config.max_candidates
        steps = math.ceil((goal - self.grasps) * each / CANDIDATE_STEP) * CANDIDATE_STEP
        return min(max(steps, config.min_candidates), most)

    def why_given_up(self, goal: int, config: EngineConfig) -> str:
        """Why the pair gets no more shards although it has too few grasps; empty if it is full or goes on."""
        if self.error or self.grasps >= goal:
            return self.error
        if self.barren >= config.max_barren_rounds:
            return f"{self.grasps} grasps, none in the last {self.barren} rounds: {self.total.main_obstacle()}"
        if self.total.candidates >= config.candidate_budget:
            return f"{self.grasps} grasps of {self.total.candidates} candidates, then given up: {self.total.main_obstacle()}"
        return ""


@dataclass(frozen=True)
class DatasetReport:
    """Result of one run."""

    grasps: int  # in the folder, for the pairs asked for
    added: int  # of them in this run
    shards: int  # made in this run
    seconds: float  # wall time [s]
    failures: dict[Pair, str]  # pairs that were given up, and why


@checked
def synthesize_dataset(
    hands: Sequence[str], objects: Sequence[str], grasps_per_pair: int, output_dir: Path | str,
    workers: int | Callable[[Job], Pool] = 2, seed: int = 0, config: EngineConfig | None = None,
    progress: Callable[[str], None] | None = None,
) -> DatasetReport:
    """Fill a folder with valid grasps of every hand on every object, which are given by names or paths.

    All pairs get their first shard before any gets its second, so a run that is stopped early is useful.

    Args:
        grasps_per_pair: A pair is finished when it has this many valid grasps.
        output_dir: The folder; made when missing.
        workers: Processes, see `simulating_threads` for the threads of each; or a function that makes another pool for a job.
        seed: Determines every shard, together with hand, object, round and number of candidates.
        progress: Called with a line of text now and then; None prints to stderr.

    Raises:
        OptionError: A number is not positive, the time is not finite, this machine lacks the device or the extra that simulates
            there, or the folder was begun with other settings (see `require_settings`).
        OutputError: The folder cannot be made or written, or another run is filling it.
    """
    config = config or EngineConfig()
    require_positive(grasps_per_pair=grasps_per_pair, workers=workers if isinstance(workers, int) else 1)
    if config.seconds is not None and not (math.isfinite(config.seconds) and config.seconds > 0):
        raise OptionError(f"seconds is {config.seconds}; give a positive number, or None for no limit")
    if isinstance(workers, int):
        require_device(config.synthesis.device)
        require_worlds(config.synthesis.device)
    folder = make_folder(output_dir)
    say = progress or (lambda line: print(line, file=sys.stderr, flush=True))
    with sole_run(folder, config.shard, mergeable=True):
        job = Job(seed, config)
        require_settings(folder, job)
        states = {pair: PairState() for pair in own_pairs(hands, objects, config.shard)}
        resume(folder, states, grasps_per_pair, say)
        before, started = sum(s.grasps for s in states.values()), time.perf_counter()
        pool = workers(job) if not isinstance(workers, int) else LocalPool(
            job, workers, config.limit, threads=simulating_threads(workers, config))
        end = math.inf if config.seconds is None else started + config.seconds
        shards = Production(pool, folder, states, grasps_per_pair, config, say, end).finish()
    total = sum(s.grasps for s in states.values())
    failures = {pair: why for pair, s in states.items() if (why := s.why_given_up(grasps_per_pair, config))}
    return DatasetReport(total, total - before, shards, time.perf_counter() - started, failures)


def simulating_threads(workers: int, config: EngineConfig) -> int:
    """Threads in which each of so many processes simulates: one; its share of the cores where a device makes the candidates."""
    return max(1, cores() // workers) if on_accelerator(config.synthesis.device) else 1


def require_known(hands: Sequence[str], objects: Sequence[str]) -> None:
    """Refuse unknown names and missing files, without reading any file that exists; folders and groups are no objects."""
    for hand in hands:
        if not locate_hand(hand).path.is_file():
            load_hand(hand)  # its error says what is wrong
    names = object_names()
    for obj in objects:
        if obj.removeprefix(ASSET_PREFIX) not in names and not given_path(obj).is_file():
            load_object(obj)  # likewise
    for name in (*hands, *objects):
        if (size := max(len(part) for part in Shard(name, name, 0).path(Path()).parts)) > LONGEST_NAME:
            raise OptionError(f"'{name}' is too long: the folder of its grasps would have a name of {size} characters, of "
                              f"{LONGEST_NAME} at most. Give a shorter path, such as one from the file's own folder")


def require_distinct_names(hands: Sequence[str], objects: Sequence[str]) -> None:
    """Refuse different files of one name, before their grasps are made: merged and bundled grasps know their names alone."""
    for kind, given, locate in (("hand", hands, locate_hand), ("object", objects, locate_object)):
        found: dict[str, tuple[str, Path]] = {}
        for source in given:
            path, name, *_ = locate(source)
            first, known = found.setdefault(name, (source, path.resolve()))
            if path.resolve() != known:
                raise OptionError(f"{kind}s '{first}' and '{source}' are both called '{name}', under which their grasps are "
                                  "merged and bundled; rename one of the files, or leave one out")


def own_pairs(hands: Sequence[str], objects: Sequence[str], shard: tuple[int, int]) -> list[Pair]:
    """The pairs of one part of a run: every pair belongs to exactly one, and parts differ by one pair at most."""
    return list(dict.fromkeys(itertools.product(hands, objects)))[shard[0] - 1 :: shard[1]]


def resume(folder: Path, states: dict[Pair, PairState], goal: int, say: Callable[[str], None]) -> None:
    """Take up the shards of earlier runs; a damaged or foreign shard is named, set aside, and made again.

    Footers tell how many grasps there are; only pairs that lack some are read whole, as their next shard needs them.
    """
    remove_leftovers(folder)
    for pair, own in itertools.groupby(find_shards(folder), lambda shard: (shard.hand, shard.object)):
        if pair in states:
            sound = _readable(folder, own, read_yield, say)
            if sum(made.valid for made in sound.values()) < goal:
                whole = _readable(folder, sound, lambda folder, shard: GraspBatch.load(shard.path(folder)), say)
                sound = {shard: sound[shard] for shard in whole}
            for shard, made in sound.items():
                states[pair].note(shard, made)


def _readable(
    folder: Path, shards: Iterable[Shard], read: Callable[[Path, Shard], Content], say: Callable[[str], None]
) -> dict[Shard, Content]:
    """What can be read of the shards; damaged ones are named and set aside, unless disk or memory fails."""
    found = {}
    for shard in shards:
        try:
            found[shard] = read(folder, shard)
        except GraspFileError as error:
            if is_unread(error):  # a disk that fails once must not cost a sound shard
                raise
            say(f"{error}; it is set aside as {set_aside(shard.path(folder)).name} and made again")
    return found


def next_pairs(states: dict[Pair, PairState], busy: set[Pair], goal: int, config: EngineConfig) -> list[Pair]:
    """The unfinished, idle pairs of one hand that are made next, together: those with the fewest rounds.

    The first is of a hand and an object that have had few. So hands take turns, and objects, and a run that ends early has
    grasps of all of them. Pairs on which a worker died come last, alone.
    """
    # New objects are spread over the workers, as preparing one can take minutes.
    open_pairs = [pair for pair, s in states.items()
                  if pair not in busy and s.grasps < goal and not s.why_given_up(goal, config)]
    prepared_now = {obj for hand, obj in busy if not states[hand, obj].total.candidates}
    turns = Counter(name for pair in busy for name in pair)
    for pair, state in states.items():
        for name in pair:
            turns[name] += len(state.done)

    def order(pair: Pair) -> tuple[float, ...]:
        state = states[pair]
        return state.crashes, pair[1] in prepared_now, len(state.done), turns[pair[0]], turns[pair[1]]

    first = min(open_pairs, default=None, key=order)
    if first is None or states[first].crashes:
        return [] if first is None else [first]
    fellows = [pair for pair in open_pairs if pair[0] == first[0] and not states[pair].crashes]
    return heapq.nsmallest(config.together, fellows, key=order)


@dataclass
class Production:
    """One run of the engine over a folder."""

    pool: Pool
    folder: Path
    states: dict[Pair, PairState]
    goal: int
    config: EngineConfig
    say: Callable[[str], None]
    end: float = math.inf  # deadline (`time.perf_counter`) after which no new shard starts
    busy: set[Pair] = field(default_factory=set)
    shards: int = 0  # finished so far

    def finish(self) -> int:
        """Keep the pool busy until every pair is finished or given up; returns the number of shards made."""
        started = told = time.perf_counter()
        try:
            while self._fill():
                for outcome in self.pool.wait(REPORT_EVERY):
                    self._collect(outcome)
                if time.perf_counter() - told > REPORT_EVERY:
                    told = time.perf_counter()
                    self.say(self._summary(told - started))
        finally:
            self.pool.close()
        self.say(self._summary(time.perf_counter() - started))
        return self.shards

    def _fill(self) -> bool:
        """Start shards while there is room; false when none is left and none in flight."""
        while self.pool.free > 0 and time.perf_counter() < self.end:
            pairs = next_pairs(self.states, self.busy, self.goal, self.config)
            if not pairs:
                break
            self.pool.submit([self._task(pair, self.config.together // len(pairs)) for pair in pairs])
            self.busy.update(pairs)
        return bool(self.busy)

    def _task(self, pair: Pair, times: int) -> Task:
        """A pair's next shard, so many times as large as it would be among others."""
        state = self.states[pair]
        earlier = tuple(Shard(*pair, i).path(self.folder).read_bytes() for i in sorted(state.done))
        missing = next(i for i in itertools.count() if i not in state.done)
        return Task(Shard(*pair, missing), times * state.next_candidates(self.goal, self.config), earlier)

    def _collect(self, outcome: Outcome) -> None:
        """Store shards, or note why there are none; one that cannot be stored ends the run, as no other could be."""
        tasks, made = outcome
        for task, own in zip(tasks, itertools.repeat(made) if isinstance(made, Failed) else made, strict=False):
            self._note(task, own)

    def _note(self, task: Task, made: FinishedShard | Failed) -> None:
        pair = (task.shard.hand, task.shard.object)
        state = self.states[pair]
        self.busy.discard(pair)
        if not isinstance(made, Failed):
            task.shard.save(made.payload, self.folder)
            state.note(task.shard, made.result)
            state.crashes = 0
            self.shards += 1
            return
        state.crashes += made.died
        if not made.died or state.crashes >= self.config.max_crashes:
            state.error = made.reason + (f", {state.crashes} times" if made.died else "")
            self.say(f"{pair[0]} on {pair[1]}: {state.error}")

    def _summary(self, seconds: float) -> str:
        states = self.states.values()
        going = [s for s in states if not s.why_given_up(self.goal, self.config)]
        return (f"{sum(s.grasps for s in states)} grasps; {sum(s.grasps >= self.goal for s in states)} of {len(states)} pairs "
                f"full, {len(states) - len(going)} given up, round {min((len(s.done) for s in going), default=0)}; "
                f"{seconds:.0f} s")


SETTINGS = "settings.json"  # File of the settings in a data set's folder
COMMAND = "command"  # Setting that says which command fills the folder
SYNTHESIZE = "synthesize"  # Its value where it is not noted
FREE = frozenset({
    "seconds", "candidates", "min_candidates", "max_candidates", "max_barren_rounds", "candidate_budget", "max_crashes",
    "shard", "shard_seconds", "together", "synthesis.device"})
"""Settings that a rerun may change: how long it goes on, where, in how large shards, and when it gives up a pair."""


def require_settings(folder: Path, job: Job) -> None:
    """Refuse a job with other settings than those that a folder was begun with; a new folder is begun with the job's.

    The note is there before the first shard. So a folder with shards and without a note is of an earlier version: it is taken
    as it is, and gets none, as nobody knows its settings. Of several processes that begin a folder at once, one writes.
    """
    agree(folder, _asked(job))


def agree(folder: Path, asked: dict[str, Any]) -> None:
    """As `require_settings`, for settings of any work, as plain values by name."""
    path = folder / SETTINGS
    found = _noted(path)
    if found is None:
        if not find_shards(folder):
            _write_once(path, json.dumps(asked, indent=1))
        found = _noted(path) or {}
    found = {COMMAND: SYNTHESIZE} | found
    if differing := [name for name, value in asked.items() if found.get(name, value) != value]:
        made, given = (", ".join(f"{name} {values[name]}" for name in differing) for values in (found, asked))
        raise OptionError(f"{folder} was begun with {made}, {given} was asked for; use the same to go on, or name another "
                          "folder, and join both with `dro-grasp dataset merge`")


def _noted(path: Path) -> dict[str, Any] | None:
    with reading(path, GraspFileError, "the settings of the grasps in its folder; remove it to go on with any"):
        try:
            found = json.loads(path.read_text())
        except FileNotFoundError:
            return None
        if not isinstance(found, dict):
            raise ValueError(f"it holds a {type(found).__name__}")
        return found


def _asked(job: Job) -> dict[str, Any]:
    """What determines the grasps, beside hand, object and the sizes of shards, as plain values by name."""
    values = {COMMAND: SYNTHESIZE, "seed": job.seed}
    values |= {name: value for name, value in flat(job.config).items() if name not in FREE}
    return json.loads(json.dumps(values, default=str))


def _write_once(path: Path, text: str) -> None:
    """Write a file, whole, unless somebody else has."""
    temporary = path.with_name(f".{path.name}{secrets.token_hex(4)}.part")
    try:
        temporary.write_text(text)
        try:
            os.link(temporary, path)
        except FileExistsError:
            return
        except OSError:  # a file system without links
            os.replace(temporary, path)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}; free some space or choose another folder") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
