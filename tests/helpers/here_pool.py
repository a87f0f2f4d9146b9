"""Runs of the data engine in this process, which say what they were given to do."""

from __future__ import annotations

from pathlib import Path

from dro_grasp.training.data.engine.pools import Outcome, Work, failure_of
from dro_grasp.training.data.engine.schedule import synthesize_dataset
from dro_grasp.training.data.engine.worker import Job, Task
from tests.helpers.engine_work import easy


class HerePool:
    """A pool that does the work in this process, one shard after the other, and remembers the tasks."""

    def __init__(self, job: Job, work: Work = easy) -> None:
        self.job, self.work = job, work
        self.waiting: list[Task] = []
        self.tasks: list[Task] = []
        self.closed = False

    @property
    def free(self) -> int:
        return 1 - len(self.waiting)

    def submit(self, task: Task) -> None:
        self.waiting.append(task)
        self.tasks.append(task)

    def wait(self, timeout: float) -> list[Outcome]:
        task = self.waiting.pop()
        try:
            return [(task, self.work(self.job, task))]
        except Exception as error:
            return [(task, failure_of(error))]

    def close(self) -> None:
        self.closed = True


def run(folder: Path, hands, objects, goal, work: Work = easy, **options):
    """A run of the engine here; its report, its tasks, and the lines it said."""
    pools, lines = [], []

    def make_pool(job: Job) -> HerePool:
        pools.append(HerePool(job, work))
        return pools[0]

    report = synthesize_dataset(hands, objects, goal, folder, progress=lines.append, workers=make_pool, **options)
    assert pools[0].closed
    return report, pools[0].tasks, lines
