"""Pools, which make shards side by side: what every pool does, and the pool of processes on this machine."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from pebble import ProcessExpired, ProcessPool

from dro_grasp.datasets.engine.threads import use_one_thread
from dro_grasp.datasets.engine.worker import FinishedShard, Job, Task, make_shard
from dro_grasp.errors import DroGraspError

Work = Callable[[Job, Task], FinishedShard]


@dataclass(frozen=True)
class Failed:
    """A shard that could not be made."""

    reason: str
    """In one line."""
    died: bool = False
    """The worker died or was stopped: a new attempt may succeed."""


Outcome = tuple[Task, FinishedShard | Failed]


@runtime_checkable
class Pool(Protocol):
    """Something that makes shards side by side."""

    @property
    def free(self) -> int:
        """Number of shards that it would start at once."""
        ...

    def submit(self, task: Task) -> None:
        """Start a shard."""
        ...

    def wait(self, timeout: float) -> list[Outcome]:
        """Shards that ended, as soon as there is one; none after `timeout` [s]."""
        ...

    def close(self) -> None:
        """Stop everything; shards in flight are dropped."""
        ...


def failure_of(error: BaseException) -> Failed:
    """An error of one shard in one line."""
    reason = str(error) if isinstance(error, DroGraspError) else f"{type(error).__name__}: {error}"
    return Failed(reason.splitlines()[0][:300] if reason else type(error).__name__)


def attempt(work: Work, job: Job, task: Task) -> FinishedShard | Failed:
    """Make a shard; an error becomes a value, as it must not stop the other shards."""
    try:
        return work(job, task)
    except Exception as error:  # a fault of ours too: `failure_of` names it
        return failure_of(error)


class LocalPool:
    """Processes of one thread each on this machine. A worker's death costs the shard it was making, no other.

    Each process has a pebble pool of its own. Processes of one pool share a lock, and one that is killed while it hands
    over its shard would keep the lock from the others.
    """

    def __init__(self, job: Job, workers: int, limit: float, work: Work = make_shard) -> None:
        """Prepare the processes; each starts with its first shard. One that takes longer than the limit [s] is stopped."""
        self.job, self.limit, self.work = job, limit, work
        self.idle = [_one_process() for _ in range(workers)]
        self.busy: dict[Future[FinishedShard | Failed], tuple[Task, ProcessPool]] = {}

    @property
    def free(self) -> int:
        """Idle processes."""
        return len(self.idle)

    def submit(self, task: Task) -> None:
        """Hand a shard to an idle process."""
        pool = self.idle.pop()
        try:
            future = pool.schedule(attempt, (self.work, self.job, task), timeout=self.limit)
        except RuntimeError:  # its process died while idle
            pool = _replaced(pool)
            future = pool.schedule(attempt, (self.work, self.job, task), timeout=self.limit)
        self.busy[future] = task, pool

    def wait(self, timeout: float) -> list[Outcome]:
        """Finished shards, errors, and shards whose process died or took too long."""
        done, _ = wait(self.busy, timeout, FIRST_COMPLETED)
        return [self._collect(future) for future in done]

    def close(self) -> None:
        """End the processes."""
        pools = [*self.idle, *(pool for _, pool in self.busy.values())]
        with ThreadPoolExecutor(len(pools)) as threads:
            list(threads.map(_end, pools))

    def _collect(self, future: Future[FinishedShard | Failed]) -> Outcome:
        task, pool = self.busy.pop(future)
        try:
            result = future.result()
        except TimeoutError:
            result = Failed(f"took longer than {self.limit:.0f} s", died=True)
        except ProcessExpired as error:
            result, pool = Failed(f"its worker process died (exit code {error.exitcode})", died=True), _replaced(pool)
        except BrokenProcessPool:
            result, pool = Failed("its worker process died before it began", died=True), _replaced(pool)
        except Exception as error:  # a result that cannot be handed over: pickling runs code of any kind
            result = failure_of(error)
        self.idle.append(pool)
        return task, result


def _one_process() -> ProcessPool:
    return ProcessPool(1, initializer=use_one_thread, context=multiprocessing.get_context("spawn"))


def _end(pool: ProcessPool) -> None:
    pool.stop()
    pool.join()


def _replaced(pool: ProcessPool) -> ProcessPool:
    """A new pool for one whose process died."""
    _end(pool)
    return _one_process()
