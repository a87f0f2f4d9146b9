"""Did it hold: closings of training grasps with the object and without, and objects that slide out or are torn away.

    python -m lab.benchmarks.hold_check [--hands HAND ...] [--objects N] [--grasps N] [--generated] [--group GROUP] [--most N]
        [--seed N] [--json]

What is expected is simulated with the object in its place. What is measured is simulated with another place, friction, mass and
servos (`robust`), under the object's weight from a random side, with noise. Grasps that move the object by 15 mm as they close
are left out, and so are those that it then leaves by itself: a plan's grasps are settled and rehearsed.

Held is what moves less than half a millimetre in the fifth of a second in which joints are watched. Slipping is what has moved
by one to six centimetres, and moves by two centimetres a second or more: it `slides` out under its own weight, as it turns out
to be heavier (half of them) or more slippery than it was, or is `torn` away by a force from another side. What lies between is
neither.

Noise of joints is `typical` of hands: 2 mrad on each reading, and 10 mrad that are wrong with all readings of a joint, as
zeros, gravity and friction are not known exactly. Servos of the LEAP hand count 4096 steps a turn, which is 0.4 mrad, and their
sensor has 0.3 to 0.8 mrad of noise; joints of the Barrett hand are measured behind a gear of 125:1; potentiometers of the DLR
hand tell steps of 1.7 mrad. `pessimistic` noise is 10 mrad on each reading, an upper end. Loads have 0.6 N of noise. Sources:
emanual.robotis.com (XC330), ams (AS5600, AS5601), support.barrett.com (BH8-280), dlr.de (DLR Hand II),
forum.universal-robots.com (thread 229: ten weighings with a Robotiq FT 300).
"""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float

from dro_grasp.compare.metrics import wilson_interval
from dro_grasp.errors import NoGraspError
from dro_grasp.geometry.contact_forces import GRAVITY
from dro_grasp.grasps.batch import GraspBatch, load_grasps
from dro_grasp.grasps.hold import STATES, HoldCheck, HoldConfig, HoldExpectation, HoldState, check_hold
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.objects.shape import ObjectModel, solid_of
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.simulation.conditions import draw
from dro_grasp.simulation.holding import closing_of, expect_hold, rest
from dro_grasp.simulation.payload import servo_torques
from dro_grasp.simulation.protocols import ROBUST
from dro_grasp.simulation.rollout import Rollout
from dro_grasp.simulation.scene import scene_of
from lab.benchmarks.report import emit, options_of

HANDS = {"allegro": "allegro", "barrett": "barrett", "leaphand": "leaphand", "shadowhand": "shadowhand", "gripper3": "gripper3"}
"""Built-in hands, and the files of their training grasps."""
DATA = Path(__file__).parents[2] / "data" / "grasps"
STILL = 0.015  # An object that has moved no farther is where it was [m]
PULLS = (1.5, 3.0, 6.0, 12.0, 25.0, 50.0)  # Forces that tear an object away, in weights; also how much heavier it may be
GLIDES = (0.7, 0.5, 0.35, 0.25, 0.15, 0.08)  # How much more slippery it may be, as factors of friction
SENSOR = 0.1  # Noise of measured efforts, as a share of the largest expected one
SCALE = HoldConfig().scale  # Noise of measured loads [N]
NOISES = {"typical": (0.002, 0.01), "pessimistic": (0.01, 0.0)}
"""Noise of single readings of joints [rad], and what is wrong with all readings of a joint [rad]."""
HOW = ("once", "once, efforts", "twice", "twice, efforts", "watched", "watched, efforts", "watched, load")
"""What is measured: joints, or efforts or load too; after the lift, or after the squeeze too, or for WATCHED seconds."""
WATCHED, EVERY = 0.2, 0.01  # How long joints are watched, and how often they are measured [s]
ROWS = round(WATCHED / EVERY) + 1
RESTS = 0.0005  # How far an object has moved at most meanwhile that is held [m]
SLIPPED = (0.01, 0.06)  # How far an object has moved that is slipping [m]
SLIPS = 0.02  # Least speed of it over the last half of the time [m/s]
KINDS: dict[str, HoldState] = {"held": "held", "empty": "empty", "slides": "slipping", "torn": "slipping"}
"""Situations, and what is true of them."""
BINS = (0.0, 0.6, 0.8, 0.9, 0.95, 1.0)  # Ends of the confidences that are counted together


@dataclass(frozen=True)
class Measured:
    """Joints of one hand in one situation [rad or m]."""

    hand: str
    kind: str  # One of KINDS
    expected: HoldExpectation
    joints: Float[np.ndarray, " n_dof"]
    efforts: Float[np.ndarray, " n_dof"]  # [Nm or N]
    before: Float[np.ndarray, " n_dof"] | None
    watched: Float[np.ndarray, "k n_dof"]  # The last row are `joints`
    load: float  # [N]


@dataclass(frozen=True)
class Slip:
    """What is measured while objects slip; NaN where they do not."""

    rows: Float[np.ndarray, "n k n_dof"]
    load: Float[np.ndarray, " n"]


def situations(hand: Hand, name: str, obj: ObjectModel, grasps: GraspBatch, rng: np.random.Generator) -> list[Measured]:
    """What is measured of some grasps of one object: held, empty, and slipping."""
    obj = solid_of(obj)
    told = expect_hold(hand, obj, grasps, workers=1)
    config = replace(ROBUST, trials=3, needed=1, coarse=0)
    conditions = draw(config, told)
    twice = GraspBatch.concatenate([told] * (config.trials - 1))
    scene = scene_of(hand, obj, twice, closing_of("carry"))
    usual = Rollout(scene, twice, 1)
    good = _stays(usual, _sides(usual, rng))[1]
    real = Rollout(scene, twice, 1, conditions=conditions)
    down = _sides(real, rng)
    closed, held = _stays(real, down)
    still, moved = _watched(real)
    held &= moved < RESTS
    slips = {"torn": _torn(real, _sides(real, rng)), "slides": _sliding(real, down, rng.random(real.size) < 0.5)}
    empty = rest(Rollout(scene, twice, 1, conditions=conditions), twice, empty=True)[0].numpy()

    def measured(kind: str, i: int, rows: Float[np.ndarray, "k n_dof"], load: float) -> Measured:
        expected = HoldExpectation.of(twice, i)
        assert expected is not None
        exerted = servo_torques(hand, torch.from_numpy(rows[-1]), twice.squeeze_joints[i].double(), scene.protocol)
        # An object that is missing from the beginning was missing before the lift, too.
        before = None if kind == "empty" else closed[i]
        return Measured(name, kind, expected, rows[-1], exerted.numpy() * conditions.gain[i], before, rows, load)

    found = []
    for i in np.flatnonzero(good & held).tolist():
        found += [measured("held", i, still[i], float(GRAVITY * real.mass[i])),
                  measured("empty", i, np.tile(empty[i], (ROWS, 1)), 0.0)]
        found += [measured(kind, i, slip.rows[i], float(slip.load[i])) for kind, slip in slips.items()
                  if np.isfinite(slip.load[i])]
    return found


def _stays(rollout: Rollout, side: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n n_dof"], Bool[np.ndarray, " n"]]:
    """Joints after closing, and whether the object stays where it was while its weight pulls from this side."""
    closed = rollout.close()
    joints = rollout.poses()[0]
    loaded = rollout.load(rollout.targets[-1], side * GRAVITY * rollout.mass[:, None], 0.5)
    return joints, (closed.shift(rollout.start) < STILL) & (loaded.shift(closed) < STILL) & loaded.stable


def _watched(rollout: Rollout) -> tuple[Float[np.ndarray, "n k n_dof"], Float[np.ndarray, " n"]]:
    """Joints at ROWS times under the forces that there are, and how far the object has moved meanwhile [m]."""
    begin = end = rollout.observe()
    rows = [rollout.poses()[0]]
    for _ in range(ROWS - 1):
        end = rollout.press(rollout.targets[-1], EVERY)
        rows.append(rollout.poses()[0])
    return np.stack(rows, 1), end.shift(begin)


def _torn(rollout: Rollout, side: Float[np.ndarray, "n 3"]) -> Slip:
    """Objects that a force tears away from a side; the least of PULLS that does so."""
    slip, moment = _never(rollout), rollout.moment()
    for weights in PULLS:
        rollout.go_back(moment)
        _slipping(rollout, weights * GRAVITY * rollout.mass[:, None] * side, slip)
    rollout.go_back(moment)
    return slip


def _sliding(rollout: Rollout, down: Float[np.ndarray, "n 3"], heavy: Bool[np.ndarray, " n"]) -> Slip:
    """Objects that slide out under their own weight, as they turn out to be heavier, or more slippery, than they were.

    It is the least of PULLS or GLIDES that lets them slide.
    """
    slip, moment, mass = _never(rollout), rollout.moment(), rollout.mass.copy()
    friction = rollout.batch.expand("geom_friction").copy()
    for weights, share in zip(PULLS, GLIDES, strict=True):
        rollout.make_heavy(np.where(heavy, weights, 1.0) * mass)
        rollout.batch.expand("geom_friction")[:] = friction * np.where(heavy, 1.0, share)[:, None, None]
        rollout.go_back(moment)
        _slipping(rollout, GRAVITY * rollout.mass[:, None] * down, slip)
    rollout.make_heavy(mass)
    rollout.batch.expand("geom_friction")[:] = friction
    rollout.go_back(moment)
    return slip


def _never(rollout: Rollout) -> Slip:
    return Slip(np.full((rollout.size, ROWS, rollout.scene.hand.tree.n_dof), np.nan), np.full(rollout.size, np.nan))


def _slipping(rollout: Rollout, force: Float[np.ndarray, "n 3"], slip: Slip) -> None:
    """Let a force [N] act, and keep what is measured of objects as they first slip, where that is not known yet."""
    begin = rollout.observe()
    rows, places, moved = [rollout.poses()[0]] * ROWS, [begin.position] * ROWS, [np.zeros(rollout.size)] * ROWS
    for _ in range(3 * ROWS):
        state = rollout.load(rollout.targets[-1], force, EVERY)
        rows, places = [*rows[1:], rollout.poses()[0]], [*places[1:], state.position]
        moved = [*moved[1:], state.shift(begin)]
        speed = (moved[-1] - moved[ROWS // 2]) / (EVERY * (ROWS - 1 - ROWS // 2))
        new = np.isnan(slip.load) & (moved[-1] > SLIPPED[0]) & (moved[-1] < SLIPPED[1]) & (speed > SLIPS)
        slip.rows[new] = np.stack(rows, 1)[new]
        # The wrist feels what does not accelerate the object.
        gained = (places[-1] - places[-2] - places[1] + places[0]) / EVERY / WATCHED
        pulls = np.einsum("nij,nj->ni", rollout.start.rotation, force) - rollout.mass[:, None] * gained
        slip.load[new] = np.linalg.norm(pulls, axis=1)[new]


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
    """At most so many situations of each hand and kind, drawn."""
    order, count, kept = np.random.default_rng(seed).permutation(len(found)), Counter[tuple[str, str]](), list[Measured]()
    for one in (found[i] for i in order):
        count[one.hand, one.kind] += 1
        if most is None or count[one.hand, one.kind] <= most:
            kept.append(one)
    return kept


def judged(found: list[Measured], noise: str, how: str, seed: int, config: HoldConfig | None = None) -> list[HoldCheck]:
    """What is said of each situation; `noise` is one of NOISES and `how` one of HOW."""
    rng, said, (each, all_alike) = np.random.default_rng(seed), list[HoldCheck](), NOISES[noise]
    for one in found:
        unit, most = one.expected.unit, float(np.abs(one.expected.held_efforts).max())
        wrong = all_alike * unit * rng.normal(size=len(unit))
        rows = one.watched + wrong + each * unit * rng.normal(size=one.watched.shape)
        efforts = one.efforts + SENSOR * most * rng.normal(size=len(unit))
        before = None if one.before is None else one.before + wrong + each * unit * rng.normal(size=len(unit))
        load = one.load + SCALE * rng.normal()
        said.append(check_hold(
            one.expected, rows[-1], efforts if "efforts" in how else None, before=before if "twice" in how else None,
            watched=rows if "watched" in how else None, seconds=WATCHED, load=load if "load" in how else None, config=config))
    return said


def counted(found: list[Measured], said: list[HoldCheck], about: tuple[str, str]) -> list[list[object]]:
    """Rows of hand, noise, how, kind, truth, n, what was said, and the share that is right with its interval."""
    table, rows = defaultdict[tuple[str, str], Counter[str]](Counter), list[list[object]]()
    for one, check in zip(found, said, strict=True):
        for hand in (one.hand, "all"):
            table[hand, one.kind][check.state] += 1
    for (hand, kind), states in sorted(table.items()):
        truth, n = KINDS[kind], states.total()
        rows.append([hand, *about, kind, truth, n, *(states[state] for state in STATES), *wilson_interval(states[truth], n)])
    return rows


def calibration(found: list[Measured], said: list[HoldCheck], about: tuple[str, str]) -> list[list[object]]:
    """Rows of noise, how, n, mean confidence, and the share that is right with its interval, by confidence."""
    confidence = np.array([check.confidence for check in said])
    right = np.array([check.state == KINDS[one.kind] for one, check in zip(found, said, strict=True)])
    rows = list[list[object]]()
    for low, high in pairwise(BINS):
        inside = (confidence > low) & (confidence <= high)
        if n := int(inside.sum()):
            rows.append([*about, n, float(confidence[inside].mean()), float(right[inside].mean()),
                         *wilson_interval(int(right[inside].sum()), n)])
    return rows


def main() -> None:
    """Measure and print."""
    parser = options_of(__doc__)
    parser.add_argument("--hands", nargs="+", default=list(HANDS), choices=list(HANDS))
    parser.add_argument("--objects", type=int, default=12)
    parser.add_argument("--grasps", type=int, default=6)
    parser.add_argument("--generated", action="store_true", help="grasps as `generate` returns them, instead of stored ones")
    parser.add_argument("--group", default="builtin:train", help="objects of these grasps")
    parser.add_argument("--most", type=int, help="at most so many situations of each kind, of each hand")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    size = (args.hands, args.objects, args.grasps, args.seed)
    found = some(generated(*size, args.group) if args.generated else gathered(*size), args.most, args.seed)
    rows, sure = list[list[object]](), list[list[object]]()
    for noise, how in product(NOISES, HOW):
        said = judged(found, noise, how, args.seed)
        rows += counted(found, said, (noise, how))
        sure += calibration(found, said, (noise, how))
    columns = ["hand", "noise", "measured", "kind", "truth", "n", *STATES, "right from", "to"]
    named = ["noise", "measured", "n", "confidence", "right", "from", "to"]
    emit("did it hold: what is said, of what is true", rows, columns,
         {"rows": [dict(zip(columns, row, strict=True)) for row in rows],
          "calibration": [dict(zip(named, row, strict=True)) for row in sure]}, args.json)
    if not args.json:
        emit("how sure, and how often right", sure, named, {}, False)


if __name__ == "__main__":
    main()
