"""Flat and thin things that an arm takes from a table: seen in depth images with a mask, pushed to the table's edge, lifted.

    python -m lab.benchmarks.flat_lifts --robot NAME --object NAME [--attempts N] [--first N] [--no-slide] [--json]

Gravity 9.81, friction 0.5 between hand, things and table, a stereo camera's noise; held for 3 s and shaken for 2 s. The table
is narrower than that of the built-in robots, so that two of its edges are within reach. One object is one cell of some minutes.
"""

from __future__ import annotations

import dataclasses
from dataclasses import replace

from dro_grasp.arm.robots.loading import load_robot
from dro_grasp.arm.robots.robot import Table
from dro_grasp.arm.tabletop.attempts import Attempt, failures
from dro_grasp.arm.tabletop.experiment import TabletopConfig, attempt
from dro_grasp.compare.metrics import wilson_interval
from dro_grasp.objects.catalogue import load_object
from dro_grasp.predict.predictor import GraspPredictor
from lab.benchmarks.report import emit, options_of

TABLE = Table(0.0, (0.45, 0.0), (1.2, 0.6))
"""What things lie on [m]: as deep as the reach of the arms around its edges allows."""
REGION = (0.33, -0.15, 0.53, 0.15)
"""Where they are put [m]."""
COLUMNS = ("robot", "object", "asked", "n", "lifted", "rate [%]", "interval [%]", "pushes", "ended in", "processor [s]")


def row(robot: str, name: str, asked: int, done: list[Attempt]) -> list[object]:
    """What the attempts with one object came to, in the order of COLUMNS."""
    held = sum(a.success for a in done)
    low, high = wilson_interval(held, len(done))
    ended = ", ".join(sorted({f"{a.stage} {sum(b.stage == a.stage for b in done)}" for a in done}))
    return [robot, name, asked, len(done), held, round(100 * held / len(done)), f"{100 * low:.0f}-{100 * high:.0f}",
            sum(a.pushes for a in done), ended, round(sum(a.processor_seconds for a in done) / len(done), 1)]


def main() -> None:
    """Measure and print."""
    parser = options_of(__doc__)
    parser.add_argument("--robot", required=True)
    parser.add_argument("--object", required=True)
    parser.add_argument("--attempts", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="number of the first attempt")
    parser.add_argument("--no-slide", action="store_true", help="as a control, without pushes")
    arguments = parser.parse_args()
    robot, obj, predictor = replace(load_robot(arguments.robot), table=TABLE), load_object(arguments.object), GraspPredictor()
    config = TabletopConfig(segment="mask", region=REGION, slide=not arguments.no_slide)
    numbers = range(arguments.first, arguments.first + arguments.attempts)
    done = [attempt(robot, obj, number, 0, predictor, config) for number in numbers]
    rows = [row(arguments.robot, obj.name, arguments.attempts, done)]
    emit(f"Lifts of '{obj.name}', which lies flat, by {arguments.robot}", rows, COLUMNS,
         {"rows": [dict(zip(COLUMNS, r, strict=True)) for r in rows], "attempts": [dataclasses.asdict(a) for a in done],
          "failures": failures(done)}, arguments.json)


if __name__ == "__main__":
    main()
