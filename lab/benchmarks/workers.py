"""Weak scaling of the data engine: each process has as many shards to make, however many processes there are.

Shards are small, so that what it costs to hand them out shows: the CPU time of the process that does, with that which joins a
cluster for it, the files, and their bytes. Start and loading of the workers are within the time.

    python -m lab.benchmarks.workers [--processes 1 2 4] [--shards 6] [--engine local|ray] [--json]
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

from dro_grasp.objects.catalogue import resolve_objects
from dro_grasp.optimize.synthesis import SynthesisConfig
from dro_grasp.training.data.engine.pools import Pool, RayPool
from dro_grasp.training.data.engine.schedule import synthesize_dataset
from dro_grasp.training.data.engine.worker import EngineConfig, Job
from lab.benchmarks.report import emit, options_of

HAND = "gripper3"
SMALL = EngineConfig(candidates=32, max_barren_rounds=1, synthesis=SynthesisConfig(steps=20))
"""Shards of a second or two."""
COLUMNS = ("processes", "shards", "time [s]", "shards a second", "efficiency", "CPU of the head [ms a shard]", "files",
           "bytes a shard")


def run(processes: int, shards: int, engine: str) -> list[float]:
    """One shard of so many pairs for each process: shards, time, CPU time of this process, files, and bytes."""
    objects = resolve_objects(["builtin:train", f"procedural:0-{processes * shards}"])[: processes * shards]

    def pool(job: Job) -> Pool:
        return RayPool(job, processes, job.config.limit)

    with tempfile.TemporaryDirectory() as folder:
        begin, used = time.perf_counter(), head_seconds(engine)
        report = synthesize_dataset(
            [HAND], objects, 1, Path(folder) / "data", pool if engine == "ray" else processes, config=SMALL)
        seconds, used = time.perf_counter() - begin, head_seconds(engine) - used
        files = [file for file in Path(folder).rglob("*.parquet") if file.is_file()]
        return [report.shards, seconds, used, len(files), sum(file.stat().st_size for file in files)]


def head_seconds(engine: str) -> float:
    """CPU time so far of this process, and of that which joined a cluster; workers of a local pool are no part of the head."""
    spent = os.times()
    return spent.user + spent.system + (spent.children_user + spent.children_system if engine == "ray" else 0.0)


def main() -> None:
    """Measure and print."""
    parser = options_of(__doc__)
    parser.add_argument("--processes", nargs="+", type=int, default=[1, 2, 4])
    parser.add_argument("--shards", type=int, default=6, help="of each process")
    parser.add_argument("--engine", choices=("local", "ray"), default="local")
    options = parser.parse_args()
    run(1, options.shards * max(options.processes), options.engine)  # convex parts and grids come to the cache
    rows: list[list[float]] = []
    for processes in options.processes:
        shards, seconds, used, files, size = run(processes, options.shards, options.engine)
        speed = shards / seconds
        base = rows[0][3] / rows[0][0] if rows else speed / processes
        rows.append([processes, shards, seconds, speed, speed / processes / base, 1e3 * used / shards, files, size / shards])
        print(*rows[-1], file=sys.stderr, flush=True)
    emit(f"Weak scaling by {options.engine} processes", rows, COLUMNS,
         {"rows": [dict(zip(COLUMNS, row, strict=True)) for row in rows]}, options.json)


if __name__ == "__main__":
    main()
