"""Interface of a pool, something that makes shards side by side, and failures of single shards."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from dro_grasp.datasets.engine.worker import FinishedShard, Job, Task
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
    except Exception as error:
        return failure_of(error)
