"""Lifts with an arm: from a camera's cloud, from the true mesh, and with any reachable grasp instead of the best.

    python benchmarks/lifts.py --output FOLDER [--robots NAME ...] [--rows cloud mesh random] [--attempts N] [--json]

One row for each robot and kind of attempt on the paper's validate objects; attempts that FOLDER holds are not repeated.
Needs the development assets and the extra `[arm]`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from report import emit

from dro_grasp.evaluation.metrics import wilson_interval
from dro_grasp.objects.catalogue import resolve_objects
from dro_grasp.planning.attempts import Attempt, TabletopConfig
from dro_grasp.planning.plan_config import PlanConfig
from dro_grasp.planning.tabletop import TabletopRun, endings, failures, processor_seconds, run_tabletop

ROWS = {
    "cloud": TabletopConfig(),
    "mesh": TabletopConfig(see="mesh"),
    "random": TabletopConfig(plan=PlanConfig(order="random")),
}
"""Kinds of attempts: what is seen, and which reachable grasp is taken."""


COLUMNS = ("robot", "row", "held", "rate [%]", "interval [%]", "planned", "ended in", "median [s]", "95 % within [s]")
"""Headings; times are of one core, from depth image to timed plan."""


def row(robot: str, kind: str, done: list[Attempt]) -> list[object]:
    """What attempts of one kind came to, in the order of COLUMNS."""
    held = sum(a.success for a in done)
    low, high = wilson_interval(held, len(done))
    seconds = processor_seconds(done)
    ended = ", ".join(f"{stage} {count}" for stage, count in endings(done).items())
    times = [None, None] if seconds is None else [round(seconds["median"], 1), round(seconds["within_95"], 1)]
    planned = sum(a.processor_seconds > 0 for a in done)
    return [robot, kind, f"{held} of {len(done)}", round(100 * held / len(done)), f"{100 * low:.0f}-{100 * high:.0f}", planned,
            ended, *times]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True, help="folder of the attempts")
    parser.add_argument("--robots", nargs="+", default=["xarm7_leaphand", "ur5e_allegro"])
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS))
    parser.add_argument("--objects", nargs="+", default=["assets:validate"])
    parser.add_argument("--attempts", type=int, default=10)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    objects, rows, lost = tuple(resolve_objects(arguments.objects)), [], []
    for robot in arguments.robots:
        for kind in arguments.rows:
            run = TabletopRun(robot, objects, arguments.attempts, config=ROWS[kind])
            done = run_tabletop(
                run, arguments.output / f"{Path(robot).stem}.parquet", arguments.workers, plans=arguments.output / kind)
            rows.append(row(robot, kind, done))
            lost += [f"{robot}, {kind}: {text}" for text in failures(done)]
    emit(f"Lifts, {arguments.attempts} attempts on each of {len(objects)} objects", rows, COLUMNS,
         {"rows": [dict(zip(COLUMNS, r, strict=True)) for r in rows], "failures": lost}, arguments.json)


if __name__ == "__main__":
    main()
