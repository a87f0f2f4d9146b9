"""Stand-ins for the work of the data engine that worker processes can import, each failing in its own way."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from dro_grasp.errors import HandError, ObjectError
from dro_grasp.training.data.engine.shards import Yield, notes_of
from dro_grasp.training.data.engine.worker import FinishedShard, Job, Task
from tests.training.data.test_shards import grasps

GRASPS = 5
"""Grasps of a shard."""


def easy(job: Job, tasks: Sequence[Task]) -> list[FinishedShard]:
    """Five grasps at once; the object `barren` gives none, the hand `broken` an error."""
    return [_easy(task) for task in tasks]


def _easy(task: Task) -> FinishedShard:
    if task.shard.hand == "broken":
        raise HandError("no hand is called 'broken'")
    if task.shard.object == "unsplit":
        raise ObjectError("the mesh cannot be cut into convex parts (CoACD found none); repair or simplify it")
    count = 0 if task.shard.object == "barren" else GRASPS
    made = Yield(candidates=task.candidates, failures={"slipped": 20 - count}, valid=count)
    return FinishedShard(task.shard, grasps(count, task.shard.hand, task.shard.object).to_bytes(notes_of(made)), made)


def slow(job: Job, tasks: Sequence[Task]) -> list[FinishedShard]:
    """The same after a moment, in which something can be killed."""
    time.sleep(0.2)
    return easy(job, tasks)


class Heavy:
    """Kills the process that pickles it."""

    def __reduce__(self):
        os.kill(os.getpid(), signal.SIGKILL)


def dying(job: Job, tasks: Sequence[Task]) -> list[FinishedShard]:
    """The worker dies on `deadly`, always, on `fragile`, the first time, and while it hands over the shard of `heavy`."""
    mark = Path(job.config.protocol) / "died"
    objects = {task.shard.object for task in tasks}
    if "deadly" in objects or ("fragile" in objects and not mark.exists()):
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    made = easy(job, tasks)
    return [replace(one, payload=Heavy()) if one.shard.object == "heavy" else one for one in made]


def endless(job: Job, tasks: Sequence[Task]) -> list[FinishedShard]:
    """`endless` never ends, like a mesh that is hard to cut."""
    if any(task.shard.object == "endless" for task in tasks):
        time.sleep(3600)
    return easy(job, tasks)


def telling_process(job: Job, tasks: Sequence[Task]) -> list[FinishedShard]:
    """Fails with the number of its process."""
    raise ObjectError(str(os.getpid()))


def telling_threads(job: Job, tasks: Sequence[Task]) -> list[FinishedShard]:
    """Fails with the number of threads that the libraries of this process use."""
    import torch

    raise ObjectError(f"{os.environ.get('OMP_NUM_THREADS')} {torch.get_num_threads()}")
