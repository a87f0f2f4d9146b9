"""Runs of the data engine in this process, which say what they were given to do."""

from __future__ import annotations

from pathlib import Path

from dro_grasp.training.data.engine.pools import Outcome, Work, attempt
from dro_grasp.training.data.engine.schedule import synthesize_dataset
from dro_grasp.training.data.engine.worker import Job, Task
from tests.helpers.engine_work import easy


class HerePool:
    """A pool that does the work in this process, one task after the other, and remembers the tasks."""

    def __init__(self, job: Job, work: Work = easy) -> None:
        self.job, self.work = job, work
        self.waiting: list[list[Task]] = []
        self.tasks: list[Task] = []
        self.closed = False

    @property
    def free(self) -> int:
        return 1 - len(self.waiting)

    def submit(self, tasks: list[Task]) -> None:
        self.waiting.append(tasks)
        self.tasks += tasks

    def wait(self, timeout: float) -> list[Outcome]:
        tasks = self.waiting.pop()
        return [(tasks, attempt(self.work, self.job, tasks))]

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
