"""Synthesise and try grasps for many hands and objects: independent shards on a local pool of processes.

Killing it at any time loses the shards in flight at most; a rerun does only what is missing.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

import torch

from dro_grasp.datasets.production import EngineConfig, Job, make_shard
from dro_grasp.datasets.records import Shard, count_grasps, find_shards, remove_leftovers
from dro_grasp.errors import DroGraspError, OptionError, OutputError

__all__ = ["DatasetReport", "EngineConfig", "synthesize_dataset"]

REPORT_EVERY = 10.0
"""Time between lines of progress [s]."""


@dataclass
class PairState:
    """Progress of one (hand, object) pair."""

    grasps: int = 0
    """Stored so far."""
    rounds: int = 0
    """Shards finished or in flight."""
    barren: int = 0
    """Rounds without a grasp since the last one with."""
    crashes: int = 0
    """Times that a worker died on it."""
    error: str = ""
    """Why it was given up, empty while it is not."""


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
    failures: dict[tuple[str, str], str]
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
    progress: Callable[[str], None] | None = None,
) -> DatasetReport:
    """Fill a folder with valid grasps of every hand on every object.

    All pairs get their first shard before any gets its second, so a run that is stopped early is useful.

    Args:
        hands: Names or paths of hands.
        objects: Names or paths of objects with meshes.
        grasps_per_pair: A pair is finished when it has this many valid grasps.
        output_dir: The folder; made when missing (its parent must exist).
        workers: Processes, of one thread each.
        seed: With hand, object and round it determines every shard.
        protocol: The trial that grasps must pass.
        config: Sizes.
        progress: Called with a line of text now and then; None prints to stderr.

    Raises:
        OptionError: A number is not positive.
        OutputError: The folder cannot be made.
    """
    if grasps_per_pair < 1 or workers < 1:
        raise OptionError(f"grasps_per_pair is {grasps_per_pair}, workers {workers}; both must be at least 1")
    config = config or EngineConfig()
    folder = make_folder(output_dir)
    states = {(hand, obj): PairState() for hand in hands for obj in objects}
    resume(folder, states)
    before, started = sum(s.grasps for s in states.values()), time.perf_counter()
    job = Job(folder, seed, protocol, config)
    say = progress or (lambda line: print(line, file=sys.stderr, flush=True))
    shards = _run(job, states, grasps_per_pair, workers, say)
    total = sum(s.grasps for s in states.values())
    failures = {pair: s.error for pair, s in states.items() if s.error}
    return DatasetReport(total, total - before, shards, time.perf_counter() - started, failures)


def make_folder(path: Path | str) -> Path:
    """The output folder, made when only itself is missing.

    Raises:
        OutputError: Its parent is missing, it is a file, or there is no permission.
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise OutputError(f"cannot write into {path}: it is a file; give a folder")
    if not path.absolute().parent.is_dir():
        raise OutputError(f"cannot make {path}: no folder {path.absolute().parent}; create it first")
    try:
        path.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot make {path}: {error.strerror}; choose another folder") from error
    if not os.access(path, os.W_OK):
        raise OutputError(f"cannot write into {path}: no permission; choose another folder")
    return path


def resume(folder: Path, states: dict[tuple[str, str], PairState]) -> None:
    """Take up what earlier runs have left in the folder."""
    remove_leftovers(folder)
    for shard in find_shards(folder):
        state = states.get((shard.hand, shard.object))
        count = None if state is None else count_grasps(folder, shard)
        if state is None or count is None or shard.round != state.rounds:
            continue
        note_shard(state, count)


def note_shard(state: PairState, count: int, started: bool = False) -> None:
    """Record a finished shard of `count` grasps; `started` when it was already counted as a round."""
    state.grasps += count
    state.rounds += not started
    state.barren = 0 if count else state.barren + 1


def next_pair(
    states: dict[tuple[str, str], PairState], busy: set[tuple[str, str]], goal: int, config: EngineConfig
) -> tuple[str, str] | None:
    """The unfinished pair with the fewest rounds that no worker is busy with, or None.

    Pairs on which a worker died come last: they run alone, so that they take no other down.
    """
    open_pairs = [
        pair for pair, s in states.items()
        if pair not in busy and not s.error and s.grasps < goal and _worth_trying(s, config)
    ]
    return min(open_pairs, key=lambda pair: (states[pair].crashes, states[pair].rounds), default=None)


def _worth_trying(state: PairState, config: EngineConfig) -> bool:
    if state.barren >= config.barren_rounds:
        state.error = f"no valid grasp in {state.barren} rounds"
    elif state.rounds >= config.most_rounds:
        state.error = f"stopped after {state.rounds} rounds with {state.grasps} grasps"
    return not state.error


def _run(
    job: Job, states: dict[tuple[str, str], PairState], goal: int, workers: int, say: Callable[[str], None]
) -> int:
    """Keep the pool busy until every pair is finished or given up; returns the number of shards made."""
    done, running, pool, told = 0, {}, _pool(workers), time.perf_counter()
    started = told
    try:
        while True:
            while len(running) < workers:
                pair = next_pair(states, set(running.values()), goal, job.config)
                if pair is None or (running and states[pair].crashes):
                    break
                running[pool.submit(make_shard, job, Shard(*pair, states[pair].rounds))] = pair
                states[pair].rounds += 1
                if states[pair].crashes:
                    break
            if not running:
                say(summary(states, goal, time.perf_counter() - started))
                return done
            finished, _ = wait(running, return_when=FIRST_COMPLETED)
            broken = False
            for future in finished:
                pair = running.pop(future)
                broken |= _collect(future, pair, states[pair], say)
                done += not states[pair].error
            if broken:
                done, pool = done, _rebuild(pool, running, states, workers)
            if time.perf_counter() - told > REPORT_EVERY:
                told = time.perf_counter()
                say(summary(states, goal, told - started))
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _collect(
    future: Future[int], pair: tuple[str, str], state: PairState, say: Callable[[str], None]
) -> bool:
    """Note a shard's outcome; true when the pool broke."""
    try:
        note_shard(state, future.result(), started=True)
        state.crashes = 0
    except BrokenProcessPool:
        _crashed(state)
        return True
    except Exception as error:  # any failure of one pair must not stop the others
        reason = str(error) if isinstance(error, DroGraspError) else f"{type(error).__name__}: {error}"
        state.error = reason.splitlines()[0][:300] if reason else type(error).__name__
        say(f"{pair[0]} on {pair[1]}: {state.error}")
    return False


def _crashed(state: PairState) -> None:
    """Note that a worker died while the pair was in flight; its round is tried once more, alone."""
    state.crashes += 1
    state.rounds -= 1
    if state.crashes >= 2:
        state.error = "a worker process died on it twice"


def _rebuild(
    pool: Executor, running: dict[Future[int], tuple[str, str]],
    states: dict[tuple[str, str], PairState], workers: int,
) -> Executor:
    """A new pool after a worker died; shards that were in flight are forgotten and come again."""
    for pair in running.values():
        _crashed(states[pair])
    running.clear()
    pool.shutdown(wait=False, cancel_futures=True)
    return _pool(workers)


def _pool(workers: int) -> Executor:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    return ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), torch.set_num_threads, (1,))


def summary(states: dict[tuple[str, str], PairState], goal: int, seconds: float) -> str:
    """One line about where a run stands."""
    grasps = sum(s.grasps for s in states.values())
    full = sum(s.grasps >= goal for s in states.values())
    given_up = sum(bool(s.error) for s in states.values())
    fewest = min((s.rounds for s in states.values() if not s.error), default=0)
    return (f"{grasps} grasps; {full} of {len(states)} pairs full, {given_up} given up, round {fewest}; "
            f"{seconds:.0f} s")
