"""Did it hold, by the joints alone: closings of shipped training grasps with the object and without, and objects pulled away.

    python -m lab.benchmarks.hold_check [--hands HAND ...] [--objects N] [--grasps N] [--generated] [--group GROUP] [--most N]
        [--encoder RAD] [--seed N]

What is expected is simulated with the object in its place. What is measured is simulated with another place, friction, mass and
servos (`robust`), under the object's weight from a random side, with noise of encoders. Grasps that move the object by 15 mm as
they close are left out, and so are those that it then leaves by itself: a plan's grasps are settled and rehearsed.
"""

from __future__ import annotations

import argparse
from collections import Counter, defaultdict
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float

from dro_grasp.compare.metrics import wilson_interval
from dro_grasp.errors import NoGraspError
from dro_grasp.grasps.batch import GraspBatch, load_grasps
from dro_grasp.grasps.hold import STATES, HoldConfig, HoldExpectation, check_hold
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.objects.shape import ObjectModel, solid_of
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.simulation.holding import closing_of, expect_hold, rest
from dro_grasp.simulation.payload import GRAVITY, servo_torques
from dro_grasp.simulation.protocols import ROBUST
from dro_grasp.simulation.rollout import Rollout, draw
from dro_grasp.simulation.scene import scene_of
from lab.benchmarks.report import emit

HANDS = {"allegro": "allegro", "barrett": "barrett", "leaphand": "leaphand", "shadowhand": "shadowhand", "gripper3": "gripper3"}
"""Built-in hands, and the files of their training grasps."""
DATA = Path(__file__).parents[2] / "data" / "grasps"
STILL = 0.015  # An object that has moved no farther is where it was [m]
PULLS = (1.5, 3.0, 6.0, 12.0, 25.0, 50.0)  # Forces that tear an object away, in weights
SENSOR = 0.1  # Noise of measured efforts, as a share of the largest expected one
HOW = ("once", "once, efforts", "twice", "twice, efforts")
"""What is measured: joints, or efforts too; after the lift, or after the squeeze too."""
SLIPPED = (0.01, 0.06)  # How far an object has moved that is slipping [m]


@dataclass(frozen=True)
class Measured:
    """Joints of one hand in one situation [rad or m]."""

    hand: str
    truth: str
    expected: HoldExpectation
    joints: Float[np.ndarray, " n_dof"]
    efforts: Float[np.ndarray, " n_dof"]  # [Nm or N]
    before: Float[np.ndarray, " n_dof"] | None


def situations(hand: Hand, name: str, obj: ObjectModel, grasps: GraspBatch, rng: np.random.Generator) -> list[Measured]:
    """What is measured of some grasps of one object: held, empty, and slipping."""
    obj = solid_of(obj)
    told = expect_hold(hand, obj, grasps, workers=1)
    config = replace(ROBUST, trials=3, needed=1, coarse=0)
    conditions = draw(config, told)
    twice = GraspBatch.concatenate([told] * (config.trials - 1))
    scene = scene_of(hand, obj, twice, closing_of("carry"))
    usual = Rollout(scene, twice, 1)
    good = _stays(usual, rng)[1]
    real = Rollout(scene, twice, 1, conditions=conditions)
    closed, held = _stays(real, rng)
    joints, ways = real.poses()[0], _slipping(real, rng)
    empty = rest(Rollout(scene, twice, 1, conditions=conditions), twice, empty=True)[0].numpy()

    def efforts(at: Float[np.ndarray, "n n_dof"]) -> Float[np.ndarray, "n n_dof"]:
        exerted = servo_torques(hand, torch.from_numpy(at), twice.squeeze_joints.double(), scene.protocol.stiffness)
        return exerted.numpy() * conditions.gain[:, None]

    pressed, idle, lost = (efforts(at) for at in (joints, empty, ways))
    found = []
    for i in np.flatnonzero(good & held):
        expected = HoldExpectation.of(twice, int(i))
        assert expected is not None
        found += [Measured(name, "held", expected, joints[i], pressed[i], closed[i]),
                  Measured(name, "empty", expected, empty[i], idle[i], None)]
        if np.isfinite(ways[i]).all():
            found.append(Measured(name, "slipping", expected, ways[i], lost[i], closed[i]))
    return found


def _stays(rollout: Rollout, rng: np.random.Generator) -> tuple[Float[np.ndarray, "n n_dof"], Bool[np.ndarray, " n"]]:
    """Joints after closing, and whether the object stays where it was while its weight pulls from some side."""
    closed = rollout.close()
    joints = rollout.poses()[0]
    loaded = rollout.load(rollout.targets[-1], _sides(rollout, rng) * GRAVITY * rollout.mass[:, None], 0.5)
    return joints, (closed.shift(rollout.start) < STILL) & (loaded.shift(closed) < STILL) & loaded.stable


def _slipping(rollout: Rollout, rng: np.random.Generator) -> Float[np.ndarray, "n n_dof"]:
    """Joints while the object is torn away; NaN where it is not, or at once."""
    begin, moment, side = rollout.observe(), rollout.moment(), _sides(rollout, rng)
    found = np.full(rollout.poses()[0].shape, np.nan)
    for weights in PULLS:
        rollout.go_back(moment)
        moved = rollout.load(rollout.targets[-1], side * weights * GRAVITY * rollout.mass[:, None], 0.15).shift(begin)
        rows = np.isnan(found).any(1) & (moved > SLIPPED[0]) & (moved < SLIPPED[1])
        found[rows] = rollout.poses()[0][rows]
    return found


def _sides(rollout: Rollout, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    side = rng.normal(size=(rollout.size, 3))
    return side / np.linalg.norm(side, axis=1, keepdims=True)


def generated(names: list[str], objects: int, grasps: int, seed: int, group: str) -> list[Measured]:
    """Situations of all hands with some objects of a group, in grasps as they are returned."""
    found, predictor = [], GraspPredictor()
    for name in names:
        hand, rng = load_hand(name), np.random.default_rng(seed)
        for key in rng.permutation(resolve_objects([group]))[:objects].tolist():
            obj = load_object(key)
            try:
                returned = predictor.predict(hand, obj, num=grasps, seed=seed)
            except NoGraspError:
                continue
            found += situations(hand, name, obj, returned, rng)
    return found


def gathered(names: list[str], objects: int, grasps: int, seed: int) -> list[Measured]:
    """Situations of all hands, each with some training objects of its file."""
    found = []
    for name in names:
        hand, stored, rng = load_hand(name), load_grasps(DATA / f"{HANDS[name]}.parquet"), np.random.default_rng(seed)
        batches = {key: batch for key, batch in stored.by_object() if batch.split[0] == "train"}
        for key in rng.permutation(sorted(batches))[:objects].tolist():
            stored_ones = batches[key][torch.from_numpy(rng.permutation(len(batches[key]))[:grasps])]
            found += situations(hand, name, load_object(key), stored_ones, rng)
    return found


def some(found: list[Measured], most: int | None, seed: int) -> list[Measured]:
    """At most so many situations of each hand and truth, drawn."""
    order, count, kept = np.random.default_rng(seed).permutation(len(found)), Counter[tuple[str, str]](), list[Measured]()
    for one in (found[i] for i in order):
        count[one.hand, one.truth] += 1
        if most is None or count[one.hand, one.truth] <= most:
            kept.append(one)
    return kept


def judged(
    found: list[Measured], encoder: float, seed: int, how: str, config: HoldConfig | None = None
) -> dict[tuple[str, str], Counter[str]]:
    """How often each hand's situations are called what, by hand and truth, with noise of encoders; `how` is one of HOW."""
    rng, table = np.random.default_rng(seed), defaultdict[tuple[str, str], Counter[str]](Counter)
    for one in found:
        unit, most = encoder * one.expected.unit, float(np.abs(one.expected.held_efforts).max())
        joints = one.joints + unit * rng.normal(size=len(unit))
        efforts = one.efforts + SENSOR * most * rng.normal(size=len(unit))
        # An object that is missing from the beginning was missing before the lift, too.
        before = None if one.before is None else one.before + unit * rng.normal(size=len(unit))
        said = check_hold(one.expected, joints, efforts if "efforts" in how else None,
                          before=before if "twice" in how else None, config=config)
        table[one.hand, one.truth][said.state] += 1
    return table


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hands", nargs="+", default=list(HANDS), choices=list(HANDS))
    parser.add_argument("--objects", type=int, default=12)
    parser.add_argument("--grasps", type=int, default=6)
    parser.add_argument("--generated", action="store_true", help="grasps as `generate` returns them, instead of stored ones")
    parser.add_argument("--group", default="builtin:train", help="objects of these grasps")
    parser.add_argument("--most", type=int, help="at most so many situations of each kind, of each hand")
    parser.add_argument("--encoder", type=float, default=0.01, help="standard deviation of measured joints [rad]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    size = (args.hands, args.objects, args.grasps, args.seed)
    found = some(generated(*size, args.group) if args.generated else gathered(*size), args.most, args.seed)
    rows = list[list[object]]()
    for how in HOW:
        table = judged(found, args.encoder, args.seed, how)
        table |= {("all", truth): sum((table[hand, truth] for hand in args.hands), Counter()) for truth in STATES}
        for (hand, truth), said in table.items():
            n = said.total()
            rows.append([hand, how, truth, n, *(said[state] for state in STATES), *wilson_interval(said[truth], n)])
    columns = ["hand", "measured", "truth", "n", *STATES, "right from", "to"]
    emit("did it hold: what is said, of what is true", rows, columns,
         {"rows": [dict(zip(columns, row, strict=True)) for row in rows]}, args.json)


if __name__ == "__main__":
    main()
