"""Grasps under `strict` and under `robust`: stored ones, and such as `generate` makes.

Stored grasps are the first of each of the ten validate objects that pass `strict` again. Predicted grasps are refined and
ranked, 16 of 64 candidates an object; all of them count, also those that fail `strict`. With `--causes`, each condition of
`robust` is also measured alone, on the stored grasps of one hand. The cost is CPU time beside that of `strict`.

    python -m lab.benchmarks.robustness [--num 7] [--causes] [--json]
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from dro_grasp.compare.metrics import finger_contact, mean_share, wilson_interval
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.sources import hand_of, object_of
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.simulation.outcome import TrialResult
from dro_grasp.simulation.protocols import Perturbations, Protocol, protocol
from dro_grasp.simulation.trial import simulate
from lab.benchmarks.report import ROOT, emit

STORED = ("assets-barrett_multidex", "assets-allegro_left", "assets-shadowhand")
"""Grasp files of the paper hands."""
PREDICTED = ("assets/allegro_left", "assets/shadowhand")
"""Hands of the predicted grasps."""
OBJECTS = ("mug", "contactdb+camera")
"""Their objects: one built-in and one of the validate objects."""
CAUSES = {
    "pose of the object": ("shift", "turn"), "friction": ("friction",), "mass": ("mass",), "servo gains": ("gain",),
    "coarse parts": ("coarse",),
}
"""Fields of Perturbations that make one condition."""

BANDS = ((1.0, 2.0), (0.75, 1.0), (0.5, 0.75), (0.0, 0.5))
"""Shares of trials held, from and below."""


@dataclass(frozen=True)
class Sample:
    """Grasps of one hand on one object."""

    hand: Hand
    obj: ObjectModel
    grasps: GraspBatch


@dataclass(frozen=True)
class Outcome:
    """Trials of one sample."""

    result: TrialResult
    fingers: int
    seconds: float
    """CPU time."""


def stored(name: str, num: int) -> Iterator[Sample]:
    """The first grasps of each validate object that pass `strict` again."""
    grasps = GraspBatch.load(Path(ROOT) / "data" / "grasps" / f"{name}.parquet")
    grasps = grasps[torch.tensor([split == "validate" for split in grasps.split])]
    hand = hand_of(grasps, None)
    for _, part in grasps.by_object():
        obj = object_of(part, None, 1.0)
        first = part[: 2 * num]
        yield Sample(hand, obj, first[simulate(hand, obj, first, "strict").success][:num])


def predicted(name: str) -> Iterator[Sample]:
    """Refined and ranked grasps."""
    hand, predictor = load_hand(name), GraspPredictor()
    for obj in map(load_object, OBJECTS):
        yield Sample(hand, obj, predictor.predict(hand, obj, num=16))


def measure(samples: list[Sample], rules: Protocol) -> list[Outcome]:
    """Trials of all samples."""
    outcomes = []
    for s in samples:
        _ = s.obj.coarse.parts
        begin = time.process_time()
        result = simulate(s.hand, s.obj, s.grasps, rules)
        outcomes.append(Outcome(result, len(s.hand.fingers), time.process_time() - begin))
    return outcomes


def row(what: str, single: list[Outcome], several: list[Outcome]) -> list[object]:
    """A line of the table, from the outcomes under `strict` and under a protocol with several trials of each grasp."""
    strict, success = (torch.cat([o.result.success for o in outcomes]) for outcomes in (single, several))
    held = torch.cat([o.result.robustness for o in several])
    reasons = Counter(f.value for o in several for f in o.result.failure if f).most_common(2)
    shares = torch.cat([o.result.fingers_in_contact / o.fingers for o in single])
    fingers, everyone = finger_contact(shares, 1)
    return [
        what, len(success), percent(*rate(strict)), percent(*rate(success)), percent(*mean_share(held)),
        *(f"{100 * float(((held >= low) & (held < high)).float().mean()):.0f}" for low, high in BANDS),
        f"{100 * fingers:.0f} ({100 * everyone:.0f})", sum(o.seconds for o in several) / sum(o.seconds for o in single),
        ", ".join(f"{reason} {count}" for reason, count in reasons),
    ]


def rate(success: torch.Tensor) -> tuple[float, float, float]:
    """Share of successes with its interval."""
    return float(success.float().mean()), *wilson_interval(int(success.sum()), len(success))


def percent(mean: float, low: float, high: float) -> str:
    """A share with its interval."""
    return "-" if math.isnan(mean) else f"{100 * mean:.1f} [{100 * low:.0f}-{100 * high:.0f}]"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--num", type=int, default=7, help="stored grasps of each hand on each object")
    parser.add_argument("--causes", action="store_true", help="also measure each condition alone")
    options = parser.parse_args()
    robust = protocol("robust")
    samples = {f"{name}, stored": list(stored(name, options.num)) for name in STORED}
    samples |= {f"{name}, predicted": list(predicted(name)) for name in PREDICTED}
    single = {name: measure(found, protocol("strict")) for name, found in samples.items()}
    several = {name: measure(found, robust) for name, found in samples.items()}
    rows = [row(name, single[name], several[name]) for name in samples]
    of_all = [[o for name in STORED for o in outcomes[f"{name}, stored"]] for outcomes in (single, several)]
    rows.insert(len(STORED), row("all, stored", *of_all))
    if options.causes:
        name = f"{STORED[1]}, stored"
        everything, none = robust.perturbations, Perturbations(trials=8, needed=6)
        for cause, fields in CAUSES.items():
            alone = replace(none, **{field: getattr(everything, field) for field in fields})
            measured = measure(samples[name], replace(robust, perturbations=alone))
            rows.append(row(f"{name}, {cause} alone", single[name], measured))
    columns = ["grasps", "n", "`strict` [%]", "`robust` [%]", "trials held [%]", "8 of 8 [%]", "6 or 7", "4 or 5", "fewer",
               "fingers (all) [%]", "cost", "failures"]
    emit("Grasps under `robust`, beside `strict`", rows, columns, {"rows": [dict(zip(columns, r, strict=True)) for r in rows]},
         options.json)


if __name__ == "__main__":
    main()
