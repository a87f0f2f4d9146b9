"""Synthesise and try grasps for many hands and objects: independent shards, here or on many machines.

Killing it at any time loses the shards in flight at most; a rerun does only what is missing.
"""

from __future__ import annotations

import itertools
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from dro_grasp.datasets.engine.pools import Failed, LocalPool, Outcome, Pool
from dro_grasp.datasets.engine.production import EngineConfig, Job, Task
from dro_grasp.datasets.engine.shards import Shard, find_shards, read_yield, remove_leftovers, sole_run
from dro_grasp.datasets.engine.yields import Yield
from dro_grasp.devices import require_device
from dro_grasp.errors import GraspFileError, OptionError
from dro_grasp.files import make_folder
from dro_grasp.hands.library import load_hand, locate_hand
from dro_grasp.objects.catalogue import ASSET_PREFIX, load_object, object_names

__all__ = ["DatasetReport", "EngineConfig", "require_known", "synthesize_dataset"]

REPORT_EVERY = 10.0
"""Time between lines of progress [s]."""
CANDIDATE_STEP = 64
"""Shards have a multiple of this many candidates."""
Pair = tuple[str, str]


@dataclass
class PairState:
    """Progress of one (hand, object) pair."""

    total: Yield = field(default_factory=Yield)
    """Of all its shards."""
    done: set[int] = field(default_factory=set)
    """Rounds that are finished; those of a damaged shard may be missing in between."""
    barren: int = 0
    """Rounds without a grasp since the last one with."""
    crashes: int = 0
    """Times that a worker died on it."""
    error: str = ""
    """Why it was given up, empty while it is not."""

    @property
    def grasps(self) -> int:
        """Stored so far."""
        return self.total.valid

    @property
    def next_round(self) -> int:
        """The first round that is missing."""
        return next(i for i in itertools.count() if i not in self.done)

    def note(self, shard: Shard, made: Yield) -> None:
        """Record a finished shard."""
        self.done.add(shard.round)
        self.total = self.total + made
        self.barren = 0 if made.valid else self.barren + 1

    def next_candidates(self, goal: int, config: EngineConfig) -> int:
        """Size of the next shard: what is missing, at the pair's yield so far, within the config's bounds."""
        if not self.total.candidates or not self.grasps:
            return config.candidates
        wanted = (goal - self.grasps) * self.total.candidates / self.grasps
        steps = math.ceil(wanted / CANDIDATE_STEP) * CANDIDATE_STEP
        return min(max(steps, config.least_candidates), config.largest_shard)


@dataclass(frozen=True)
class DatasetReport:
    """What a run of the engine did."""

    grasps: int
    """Grasps in the folder for the pairs asked for."""
    added: int
    """Of these, made in this run."""
    shards: int
    """Shards made in this run."""
    seconds: float
    """Wall time [s]."""
    failures: dict[Pair, str]
    """Pairs that were given up, and why."""


def synthesize_dataset(
    hands: Sequence[str],
    objects: Sequence[str],
    grasps_per_pair: int,
    output_dir: Path | str,
    workers: int = 2,
    seed: int = 0,
    protocol: str = "strict",
    config: EngineConfig | None = None,
    scale: float = 1.0,
    progress: Callable[[str], None] | None = None,
    make_pool: Callable[[Job], Pool] | None = None,
    seconds: float | None = None,
) -> DatasetReport:
    """Fill a folder with valid grasps of every hand on every object.

    All pairs get their first shard before any gets its second, so a run that is stopped early is useful.

    Args:
        hands: Names or paths of hands.
        objects: Names or paths of objects with meshes.
        grasps_per_pair: A pair is finished when it has this many valid grasps.
        output_dir: The folder; made when missing (its parent must exist).
        workers: Processes, of one thread each.
        seed: With hand, object, round and the number of candidates it determines every shard.
        protocol: The trial that grasps must pass.
        config: Sizes.
        scale: Multiplies the coordinates of all objects.
        progress: Called with a line of text now and then; None prints to stderr.
        make_pool: Where shards are made; None makes them in processes of this machine.
        seconds: No shard is begun after this time [s]; those in the making are finished.

    Raises:
        OptionError: A number is not positive, the time is not finite, or this machine lacks the device.
        OutputError: The folder cannot be made or written, or another run is filling it.
    """
    if grasps_per_pair < 1 or workers < 1:
        raise OptionError(f"grasps_per_pair is {grasps_per_pair}, workers {workers}; both must be at least 1")
    if seconds is not None and not (math.isfinite(seconds) and seconds > 0):
        raise OptionError(f"seconds is {seconds}; give a positive number, or None for no limit")
    config = config or EngineConfig()
    if make_pool is None:
        require_device(config.synthesis.device)
    folder = make_folder(output_dir)
    say = progress or (lambda line: print(line, file=sys.stderr, flush=True))
    with sole_run(folder):
        states = {(hand, obj): PairState() for hand in hands for obj in objects}
        resume(folder, states, say)
        before, started = sum(s.grasps for s in states.values()), time.perf_counter()
        job = Job(seed, protocol, config, scale)
        pool = make_pool(job) if make_pool else LocalPool(job, workers, config.shard_limit)
        end = math.inf if seconds is None else started + seconds
        shards = Run(pool, folder, states, grasps_per_pair, config, say, end).finish()
    total = sum(s.grasps for s in states.values())
    failures = {pair: s.error for pair, s in states.items() if s.error}
    return DatasetReport(total, total - before, shards, time.perf_counter() - started, failures)


def require_known(hands: Sequence[str], objects: Sequence[str]) -> None:
    """Refuse names that stand for nothing and files that do not exist, without reading any that do.

    Args:
        hands: Names or paths of hands.
        objects: Names or paths of objects, without folders and groups.

    Raises:
        HandError: A hand's name or file is missing.
        ObjectError: Likewise of an object.
    """
    for hand in hands:
        if not locate_hand(hand)[0].expanduser().is_file():
            load_hand(hand)  # says what is wrong
    names = object_names()
    for obj in objects:
        if obj.removeprefix(ASSET_PREFIX) not in names and not Path(obj).expanduser().is_file():
            load_object(obj)  # likewise


def resume(folder: Path, states: dict[Pair, PairState], say: Callable[[str], None]) -> None:
    """Take up what earlier runs have left in the folder; a damaged or foreign shard is named and made again."""
    remove_leftovers(folder)
    for shard in find_shards(folder):
        state = states.get((shard.hand, shard.object))
        if state is None:
            continue
        try:
            state.note(shard, read_yield(folder, shard))
        except GraspFileError as error:
            say(f"{error}; it is made again")


def next_pair(states: dict[Pair, PairState], busy: set[Pair], goal: int, config: EngineConfig) -> Pair | None:
    """The unfinished pair with the fewest rounds that no worker is busy with, or None.

    Objects that come for the first time are spread over the workers, since preparing one can take minutes; pairs on
    which a worker died come last.
    """
    open_pairs = [
        pair for pair, s in states.items()
        if pair not in busy and not s.error and s.grasps < goal and _worth_trying(s, config)
    ]
    prepared_now = {obj for hand, obj in busy if not states[hand, obj].total.candidates}
    return min(
        open_pairs, key=lambda pair: (states[pair].crashes, pair[1] in prepared_now, len(states[pair].done)), default=None
    )


def _worth_trying(state: PairState, config: EngineConfig) -> bool:
    if state.barren >= config.barren_rounds:
        state.error = f"{state.grasps} grasps, none in the last {state.barren} rounds: {state.total.main_obstacle()}"
    elif state.total.candidates >= config.most_candidates:
        state.error = (f"{state.grasps} grasps of {state.total.candidates} candidates, then given up: "
                       f"{state.total.main_obstacle()}")
    return not state.error


@dataclass
class Run:
    """One run of the engine over a folder."""

    pool: Pool
    folder: Path
    states: dict[Pair, PairState]
    goal: int
    config: EngineConfig
    say: Callable[[str], None]
    end: float = math.inf
    """When no more shards are begun, by the performance counter [s]."""
    busy: set[Pair] = field(default_factory=set)
    made: int = 0

    def finish(self) -> int:
        """Keep the pool busy until every pair is finished or given up; returns the number of shards made."""
        started = told = time.perf_counter()
        try:
            while self._fill():
                for outcome in self.pool.wait(REPORT_EVERY):
                    self._collect(outcome)
                if time.perf_counter() - told > REPORT_EVERY:
                    told = time.perf_counter()
                    self.say(summary(self.states, self.goal, told - started))
        finally:
            self.pool.close()
        self.say(summary(self.states, self.goal, time.perf_counter() - started))
        return self.made

    def _fill(self) -> bool:
        """Start shards while there is room; false when none is left and none in flight."""
        while self.pool.free > 0 and time.perf_counter() < self.end:
            pair = next_pair(self.states, self.busy, self.goal, self.config)
            if pair is None:
                break
            state = self.states[pair]
            earlier = tuple(Shard(*pair, i).path(self.folder).read_bytes() for i in sorted(state.done))
            self.pool.submit(Task(Shard(*pair, state.next_round), state.next_candidates(self.goal, self.config), earlier))
            self.busy.add(pair)
        return bool(self.busy)

    def _collect(self, outcome: Outcome) -> None:
        """Store a shard, or note why there is none.

        Raises:
            OutputError: It cannot be stored; then no other could be.
        """
        task, result = outcome
        pair = (task.shard.hand, task.shard.object)
        state = self.states[pair]
        self.busy.discard(pair)
        if not isinstance(result, Failed):
            task.shard.save(result.payload, self.folder)
            state.note(task.shard, result.result)
            state.crashes = 0
            self.made += 1
            return
        state.crashes += result.died
        if not result.died or state.crashes >= self.config.most_crashes:
            state.error = result.reason + (f", {state.crashes} times" if result.died else "")
            self.say(f"{pair[0]} on {pair[1]}: {state.error}")


def summary(states: dict[Pair, PairState], goal: int, seconds: float) -> str:
    """One line about where a run stands."""
    grasps = sum(s.grasps for s in states.values())
    full = sum(s.grasps >= goal for s in states.values())
    given_up = sum(bool(s.error) for s in states.values())
    fewest = min((len(s.done) for s in states.values() if not s.error), default=0)
    return (f"{grasps} grasps; {full} of {len(states)} pairs full, {given_up} given up, round {fewest}; "
            f"{seconds:.0f} s")
