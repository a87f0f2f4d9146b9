"""Lifts with an arm: from a camera's cloud, among other things, put down again, from the true mesh, and controls.

    python -m lab.benchmarks.lifts [--robots NAME ...] [--rows cloud place ...] [--objects NAME ...] [--attempts N] [--seed N]
        [--output FOLDER] [--json]

One row for each robot and kind of attempt, by default on the built-in test objects. Attempts that FOLDER holds are not
repeated, whatever code made them, and their plans are stored in it: `python -m lab.benchmarks.plan_check FOLDER` checks them
again. Needs the extra `[arm]`; the mean grasp needs a bundle of training grasps (--bundle).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from dro_grasp.arm.planning.reachability import Fault
from dro_grasp.arm.planning.task import PlanConfig
from dro_grasp.arm.planning.workcell import upright
from dro_grasp.arm.robots.loading import load_robot
from dro_grasp.arm.tabletop.attempts import Attempt, endings, failures, lifted, processor_seconds
from dro_grasp.arm.tabletop.experiment import TabletopConfig, attempt
from dro_grasp.arm.tabletop.run import TabletopRun, run_tabletop
from dro_grasp.arm.tabletop.table_scene import PickedObject
from dro_grasp.compare.methods import mean_grasps_of
from dro_grasp.compare.metrics import wilson_interval
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.choice import ChoiceConfig
from dro_grasp.predict.sources.controls import MeanGrasp, mean_grasps
from dro_grasp.predict.stages import complete
from dro_grasp.training.data.bundle.training_file import load_bundle
from lab.benchmarks.report import emit, options_of

ROWS = {
    "cloud": TabletopConfig(),
    "mesh": TabletopConfig(see="mesh"),
    "score alone": TabletopConfig(plan=PlanConfig(rehearsals=0)),
    "random": TabletopConfig(plan=PlanConfig(order="random")),
    "asked": TabletopConfig(clutter=3),
    "place": TabletopConfig(place=True),
    "clutter": TabletopConfig(clutter=3, segment="mask"),
    "mean grasp": TabletopConfig(plan=PlanConfig(order="random")),
}
"""Kinds of attempts: what is seen, what stands around it, and which reachable grasp is taken."""
MEAN_GRASPS = 64
"""Rotations of the mean grasp, of which any is taken that the arm can carry out (ours)."""
COLUMNS = ("robot", "row", "asked", "n", "success", "rate [%]", "interval [%]", "planned", "of reachable", "ended in",
           "median [s]", "95 % within [s]", "grasps [%]", "image to plan [s], median", "longest")
"""Headings; `n` are the attempts that count: all, or those that were lifted where the object is put down. `of reachable` are
those with a grasp that the arm reaches. Times are of one core, from depth image to timed plan, and then by the clock, and
`grasps` is the share of planning in which grasps are made: network, refinement and ranking."""


def row(robot: str, kind: str, done: list[Attempt]) -> list[object]:
    """What attempts of one kind came to, in the order of COLUMNS."""
    counted = lifted(done) if kind == "place" else done
    held = sum(a.success for a in counted)
    low, high = wilson_interval(held, len(counted)) if counted else (0.0, 1.0)
    seconds = processor_seconds(done)
    ended = ", ".join(f"{stage} {count}" for stage, count in endings(done).items())
    times = [None, None] if seconds is None else [round(seconds["median"], 1), round(seconds["within_95"], 1)]
    planned = sum(a.processor_seconds > 0 for a in done)
    reachable = planned + sum(a.stage == "plan" and Fault.NO_PATH in a.reason for a in done)
    shares = [a.grasp_seconds / a.plan_seconds for a in done if a.plan_seconds > 0]
    clock = [a.see_seconds + a.plan_seconds for a in done if a.plan_seconds > 0]
    return [robot, kind, len(done), len(counted), held, round(100 * held / len(counted)) if counted else None,
            f"{100 * low:.0f}-{100 * high:.0f}", planned, reachable, ended, *times,
            round(100 * float(np.median(shares))) if shares else None,
            *([round(float(np.median(clock)), 1), round(max(clock), 1)] if clock else [None, None])]


def mean_grasp_attempts(run: TabletopRun, mean: MeanGrasp) -> Iterator[Attempt]:
    """The same attempts with the mean training grasp at random rotations; nothing looks at the object's shape."""
    robot, predictor = load_robot(run.robot), GraspPredictor()

    def propose(seen: PickedObject, T_world_object: np.ndarray, seed: int) -> GraspBatch:
        obj, T = upright(seen.obj, T_world_object)
        problem = GraspProblem(robot.hand, obj)
        grasps = complete(problem, mean_grasps(problem, mean, MEAN_GRASPS, seed, ChoiceConfig.first()))
        T = torch.from_numpy(T).float()
        return grasps.replace(T_object_wrist=T @ grasps.T_object_wrist, score=torch.zeros(len(grasps)))

    for name in run.objects:
        obj = load_object(name)
        for number in range(run.attempts):
            yield replace(attempt(robot, obj, number, run.seed, predictor, run.config, proposer=propose), robot_file=run.robot)


def main() -> None:
    """Measure and print."""
    parser = options_of(__doc__)
    parser.add_argument("--output", type=Path, help="folder of the attempts; they are not stored without")
    parser.add_argument("--robots", nargs="+", default=["xarm7_leaphand", "ur5e_allegro"])
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=["cloud", "mesh", "random"])
    parser.add_argument("--objects", nargs="+", default=["builtin:test"])
    parser.add_argument("--attempts", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--bundle", type=Path, help="training grasps, for the mean grasp")
    arguments = parser.parse_args()
    if "mean grasp" in arguments.rows and arguments.bundle is None:
        parser.error("the mean grasp needs training grasps: --bundle PATH")
    if arguments.output is not None:
        arguments.output.mkdir(parents=True, exist_ok=True)
    objects, rows, lost = tuple(resolve_objects(arguments.objects)), [], []
    attempts: list[dict[str, object]] = []
    for robot in arguments.robots:
        for kind in arguments.rows:
            run = TabletopRun(robot, objects, arguments.attempts, arguments.seed, config=ROWS[kind])
            if kind == "mean grasp":
                mean = mean_grasps_of(load_bundle(arguments.bundle))[load_robot(robot).hand.name]
                done = list(mean_grasp_attempts(run, mean))
            else:
                folder = arguments.output
                file, plans = (None, None) if folder is None else (folder / f"{Path(robot).stem}.parquet", folder / kind)
                done = run_tabletop(run, file, arguments.workers, plans=plans)
            rows.append(row(robot, kind, done))
            attempts += [dataclasses.asdict(attempt) for attempt in done]
            lost += [f"{robot}, {kind}: {text}" for text in failures(done)]
    emit(f"Lifts, {arguments.attempts} attempts on each of {len(objects)} objects", rows, COLUMNS,
         {"rows": [dict(zip(COLUMNS, r, strict=True)) for r in rows], "attempts": attempts, "failures": lost}, arguments.json)


if __name__ == "__main__":
    main()
