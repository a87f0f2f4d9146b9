"""Where shards are made: processes of this machine. A worker's death costs the shard it was working on, no other."""

from __future__ import annotations

import math
import multiprocessing
import multiprocessing.connection
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Protocol, runtime_checkable

from dro_grasp.datasets.engine.production import Job, Made, Task, make_shard
from dro_grasp.errors import DroGraspError

Work = Callable[[Job, Task], Made]


@dataclass(frozen=True)
class Failed:
    """A shard that was not made."""

    reason: str
    """In one line."""
    died: bool = False
    """The worker died or was stopped: trying again may help."""


Outcome = tuple[Task, Made | Failed]


@runtime_checkable
class Pool(Protocol):
    """Something that makes shards side by side."""

    @property
    def free(self) -> int:
        """How many more shards it would start at once."""
        ...

    def submit(self, task: Task) -> None:
        """Start a shard."""
        ...

    def wait(self, timeout: float) -> list[Outcome]:
        """What has ended, as soon as something has; nothing after `timeout` [s]."""
        ...

    def close(self) -> None:
        """Stop everything; shards in flight are dropped."""
        ...


def failure_of(error: BaseException) -> Failed:
    """An error of one shard in one line, which must not stop the others."""
    reason = str(error) if isinstance(error, DroGraspError) else f"{type(error).__name__}: {error}"
    return Failed(reason.splitlines()[0][:300] if reason else type(error).__name__)


@dataclass
class _Worker:
    """One process, and the shard it works on."""

    process: SpawnProcess
    pipe: Connection
    task: Task | None = None
    since: float = math.inf


class LocalPool:
    """Processes of one thread each on this machine."""

    def __init__(self, job: Job, workers: int, limit: float, work: Work = make_shard) -> None:
        """Start the processes.

        Args:
            job: What all shards share.
            workers: How many.
            limit: A shard that takes longer is stopped [s].
            work: Makes a shard.
        """
        self.job, self.limit, self.work = job, limit, work
        self.workers = [self._start() for _ in range(workers)]

    @property
    def free(self) -> int:
        """Idle processes."""
        return sum(worker.task is None for worker in self.workers)

    def submit(self, task: Task) -> None:
        """Hand a shard to an idle process."""
        worker = next(w for w in self.workers if w.task is None)
        worker.task, worker.since = task, math.inf
        try:
            worker.pipe.send(task)
        except OSError:
            pass  # it died while idle; `wait` finds it

    def wait(self, timeout: float) -> list[Outcome]:
        """Shards made, errors, and shards whose process died or took too long."""
        busy = {worker.pipe: worker for worker in self.workers if worker.task is not None}
        ready = multiprocessing.connection.wait(list(busy), timeout)
        outcomes = [self._receive(busy[pipe]) for pipe in ready if isinstance(pipe, Connection)]
        ended = [outcome for outcome in outcomes if outcome is not None]
        late = [w for w in self.workers if w.task is not None and time.monotonic() - w.since > self.limit]
        return ended + [self._replace(w, f"took longer than {self.limit:.0f} s") for w in late]

    def close(self) -> None:
        """End the processes."""
        for worker in self.workers:
            worker.process.kill()
            worker.process.join()
            worker.pipe.close()

    def _start(self) -> _Worker:
        # Threads of one process would compete with the other processes.
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        here, there = multiprocessing.Pipe()
        process = multiprocessing.get_context("spawn").Process(target=_serve, args=(there, self.job, self.work), daemon=True)
        process.start()
        there.close()
        return _Worker(process, here)

    def _receive(self, worker: _Worker) -> Outcome | None:
        """A worker's result; None when it only says that it begins, from when on its time counts."""
        try:
            result = worker.pipe.recv()
        except (EOFError, OSError):
            worker.process.join()
            return self._replace(worker, f"its worker process died (exit code {worker.process.exitcode})")
        if result is None:
            worker.since = time.monotonic()
            return None
        assert worker.task is not None
        task, worker.task = worker.task, None
        return task, result

    def _replace(self, worker: _Worker, reason: str) -> Outcome:
        """A new process in place of one that died or must end."""
        assert worker.task is not None
        worker.process.kill()
        worker.process.join()
        worker.pipe.close()
        self.workers[self.workers.index(worker)] = self._start()
        return worker.task, Failed(reason, died=True)


def _serve(pipe: Connection, job: Job, work: Work) -> None:
    """What a process does: shards, one after the other, until the parent is gone."""
    import torch

    torch.set_num_threads(1)
    while True:
        try:
            task = pipe.recv()
            pipe.send(None)
        except (EOFError, OSError, KeyboardInterrupt):
            return
        try:
            result: Made | Failed = work(job, task)
        except Exception as error:  # any failure of one pair must not stop the others
            result = failure_of(error)
        try:
            pipe.send(result)
        except OSError:
            return
