"""Speed-up by a second worker: the same shards made by one process and by two, including start and loading.

python -m lab.benchmarks.workers [--json]
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from dro_grasp.training.data.engine.schedule import DatasetReport, synthesize_dataset
from dro_grasp.training.data.engine.worker import EngineConfig
from lab.benchmarks.report import emit
from lab.benchmarks.synthesis import HANDS

OBJECTS = ("sphere", "can", "bottle", "mug")
"""Built-in objects, one shard for each hand; their geometry is in the cache after the first run."""


def run(workers: int) -> DatasetReport:
    """One shard of every pair."""
    with tempfile.TemporaryDirectory() as folder:
        return synthesize_dataset(HANDS, OBJECTS, 1, Path(folder) / "data", workers, config=EngineConfig(max_barren_rounds=1))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    run(2)
    reports = {workers: run(workers) for workers in (1, 2)}
    rows = [[n, r.shards, r.grasps, r.seconds, reports[1].seconds / r.seconds] for n, r in reports.items()]
    emit("The same shards by one worker and by two", rows, ["workers", "shards", "grasps", "time [s]", "times faster"],
         {"speedup_of_two": reports[1].seconds / reports[2].seconds}, options.json)


if __name__ == "__main__":
    main()
