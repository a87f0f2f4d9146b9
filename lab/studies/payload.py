"""Error of payloads: what is predicted, what is weighed and returned, and what a linear program allows, beside trials.

The payload by trials is the largest mass at which a grasp holds under `carry` while it squeezes for that mass, found by halving
the interval of logarithms. It is found twice, in other intervals: trials of a heavier mass may hold where those of a
lighter one do not, and no prediction is nearer to trials than they are to each other. Grasps that hold no mass that is
tried have no payload to compare, and are counted.

    python -m lab.studies.payload --hands dclaw inspire --pairs 12 [--json]
"""

from __future__ import annotations

import random
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.stats import spearmanr

from dro_grasp.errors import NoGraspError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.predict.config import GraspRequest, PredictorConfig
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.settling import weigh_settled_all
from dro_grasp.simulation.conditions import Conditions
from dro_grasp.simulation.contacts import measure_penetration
from dro_grasp.simulation.forces import largest_payloads
from dro_grasp.simulation.grasp_state import WeightConfig, grasp_state, press, squeezes_of
from dro_grasp.simulation.payload import Squeezes
from dro_grasp.simulation.pressure import contact_forces
from dro_grasp.simulation.rollout import Rollout, rollouts
from dro_grasp.simulation.scene import TrialScene, scene_of
from dro_grasp.simulation.trial import run_trial
from dro_grasp.simulation.weighing import WeighingConfig, observed
from lab.benchmarks.report import emit, options_of

ROUNDS = 7  # Halvings of the interval
INTERVALS = (0.01, 20.0), (0.013, 15.0)  # Masses between which payloads are looked for, each time [kg]
WEIGHED, AGAIN = "weighed", "trials again"
WAYS = ("predicted, closing included", WEIGHED, "linear program", AGAIN)


@dataclass
class Pair:
    """Grasps of one pair, ready to squeeze for any mass."""

    scene: TrialScene
    grasps: GraspBatch
    chosen: Squeezes

    def hold(self, mass: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Which grasps hold these masses [kg] in a trial."""
        n, none = len(mass), np.zeros((len(mass), 3))
        squeeze = self.chosen.targets(torch.from_numpy(mass).float()[:, None])[:, 0]
        grasps = self.grasps.replace(squeeze_joints=squeeze)
        conditions = Conditions(none, none, np.ones(n), mass / self.scene.obj.mass, np.ones(n))
        rollout = Rollout(self.scene, grasps, 1, conditions=conditions)
        return run_trial(rollout, measure_penetration(self.scene, grasps)).success.numpy()

    def by_trials(self, least: float, most: float) -> Float[np.ndarray, " n"]:
        """The payload by trials [kg]; `least` where none of the masses tried is held."""
        low, high = (np.full(len(self.grasps), np.log(bound)) for bound in (least, most))
        failed = np.ones(len(low), bool)
        for _ in range(ROUNDS):
            middle = (low + high) / 2
            held = self.hold(np.exp(middle))
            failed &= ~held
            low, high = np.where(held, middle, low), np.where(held, high, middle)
        return np.where(failed, least, np.exp((low + high) / 2))


def measure(hand_name: str, object_name: str, grasps: int, seed: int) -> Iterator[dict[str, float | str]]:
    """The payloads of each grasp of a pair that settles."""
    config = PredictorConfig()
    if config.finish.settle is None:
        raise ValueError("payloads are of settled grasps; the configuration settles none")
    rules, asked = config.finish.settle, config.finish.settle.weight
    light = replace(rules, weight=WeightConfig(margin=0.0, pull=0.0))  # the squeeze without the weight is what others add to
    predictor = GraspPredictor(config=replace(config, finish=replace(config.finish, settle=light, weigh=None)))
    problem = GraspProblem(load_hand(hand_name), load_object(object_name))
    try:
        free = predictor.run(problem, GraspRequest(grasps, seed, 2)).grasps
    except NoGraspError:
        return
    free = free[free.payload.isfinite()]  # what has settled
    if not len(free):
        return
    pair, clock = ready(problem, free, asked), [time.process_time()]
    pressed = press(problem.hand, problem.obj, free, "carry", config=asked, workers=1)
    state, _ = grasp_state(problem.hand, problem.obj, pressed, "carry", config=asked, workers=1)
    told = pressed.replace(payload=observed(pressed.payload, state.gave, problem.obj.mass))
    clock.append(time.process_time())
    found = weigh_settled_all([problem], [told], WeighingConfig(), rules)[0]
    clock.append(time.process_time())
    program = largest_payloads(pair.chosen, asked.payload)
    clock.append(time.process_time())
    truth, again = (pair.by_trials(*interval) for interval in INTERVALS)
    times = dict(zip(WAYS, 1e3 * np.diff(clock) / len(free), strict=False))
    for row in zip(told.payload, found, program, again, truth, strict=True):
        yield {"hand": hand_name, "object": object_name, **dict(zip((*WAYS, "trials"), map(float, row), strict=True)),
               **{f"{way} [ms]": float(t) for way, t in times.items()}}


def ready(problem: GraspProblem, grasps: GraspBatch, config: WeightConfig) -> Pair:
    """Grasps that squeeze for no weight yet, ready to squeeze for any."""
    (part, rollout), = rollouts(scene_of(problem.hand, problem.obj, grasps, "carry"), problem.hand, grasps, workers=1)
    rollout.close()
    joints = torch.from_numpy(rollout.poses()[0]).float()
    return Pair(rollout.scene, part, squeezes_of(problem.hand, contact_forces(rollout), joints, part.squeeze_joints, config))


def summary(rows: list[dict[str, float | str]]) -> list[list[object]]:
    """For each way: n, median relative error, quarter of the largest errors, rank correlation, and time."""
    truth = np.array([row["trials"] for row in rows], float)
    some = truth > INTERVALS[0][0]
    lines: list[list[object]] = []
    for way in WAYS:
        value = np.array([row[way] for row in rows], float)
        error = np.abs(value / truth - 1)[some]
        spent = [row[f"{way} [ms]"] for row in rows if f"{way} [ms]" in row]
        lines.append([way, int(some.sum()), 100 * float(np.median(error)), 100 * float(np.quantile(error, 0.75)),
                      float(np.median((value / truth)[some])), float(np.asarray(spearmanr(value[some], truth[some]))[0]),
                      float(np.mean(np.array(spent, float))) if spent else "-"])
    return lines


def main() -> None:
    """Measure and print."""
    parser = options_of(__doc__)
    parser.add_argument("--hands", nargs="+", default=["assets/barrett_multidex", "assets/allegro_left", "leaphand"])
    parser.add_argument("--objects", nargs="+", default=["builtin:hard_train", "assets:train"], help="groups, drawn from alike")
    parser.add_argument("--pairs", type=int, default=12)
    parser.add_argument("--grasps", type=int, default=6, help="grasps of each pair")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    draw, groups = random.Random(options.seed), [resolve_objects([group]) for group in options.objects]
    rows: list[dict[str, float | str]] = []
    for i in range(options.pairs):
        pair = options.hands[i % len(options.hands)], draw.choice(groups[i % len(groups)])
        rows += measure(*pair, options.grasps, options.seed)
    lost = sum(float(row["trials"]) <= INTERVALS[0][0] for row in rows)
    emit(f"{len(rows)} settled grasps of {options.pairs} pairs, {lost} of which hold no mass in trials", summary(rows),
         ["payload", "n", "median error [%]", "third quartile [%]", "median ratio", "rank correlation", "ms a grasp"],
         {"settled": len(rows), "hold nothing": lost, "rows": rows}, options.json)


if __name__ == "__main__":
    main()
