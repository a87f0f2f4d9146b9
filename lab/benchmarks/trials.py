"""Trials per second under a protocol, by wall clock on all cores, and the slowest objects.

The grasps are synthesized, so most trials run to their end; a trial that fails early is cheaper. The time is that of
`simulate`, including penetration and scene building (64 grasps per pair with `--full`, otherwise 16), but not the loading of
hands and objects.

    python -m lab.benchmarks.trials [--json] [--full] [--seed 0] [--protocol carry] [--workers N]
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from dro_grasp.devices import cores
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimize.synthesis import SynthesisConfig, synthesize
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, PROTOCOLS
from dro_grasp.simulation.trial import TrialResult, simulate
from lab.benchmarks.report import emit, options_of

HANDS = ("assets/barrett_multidex", "assets/allegro_left", "assets/shadowhand")
"""The paper hands."""
SAMPLE = 16
"""Grasps of each hand on each object."""
FULL = 64
"""The same with `--full`."""
STEPS = 120
"""Steps of the synthesis, enough for grasps that mostly hold."""


@dataclass(frozen=True)
class Run:
    """Trials of one hand on one object."""

    object: str
    result: TrialResult
    seconds: float
    """Wall clock."""
    cpu_seconds: float
    """Of all threads."""


def validate_objects() -> list[str]:
    """Names of the paper's validation objects."""
    manifest = Path(os.environ["DRO_GRASP_ASSETS"]) / "objects" / "manifest.json"
    return sorted(e["name"] for e in json.loads(manifest.read_text()) if e["multidex_split"] == "validate")


def measure(hand_name: str, options: argparse.Namespace) -> list[Run]:
    """Try grasps of every object."""
    hand, runs = load_hand(hand_name), []
    for name in validate_objects():
        obj = load_object(name)
        _ = obj.parts
        grasps = synthesize(hand, obj, FULL if options.full else SAMPLE, options.seed, SynthesisConfig(steps=STEPS))
        wall, cpu = time.perf_counter(), time.process_time()
        result = simulate(hand, obj, grasps, options.protocol, workers=options.workers)
        runs.append(Run(name, result, time.perf_counter() - wall, time.process_time() - cpu))
        print(f"{hand_name} on {name}: {len(grasps) / runs[-1].seconds:.0f} trials/s", file=sys.stderr)
    return runs


def row(hand: str, runs: list[Run]) -> list[object]:
    """A line of the table."""
    trials = sum(len(r.result.success) for r in runs)
    slowest = max(runs, key=lambda r: r.seconds)
    failures = Counter(x.value for r in runs for x in r.result.failure if x)
    return [
        hand, trials, rate(runs), sum(r.cpu_seconds for r in runs) / trials * 1e3, slowest.object, rate([slowest]),
        100 * sum(int(r.result.success.sum()) for r in runs) / trials,
        ", ".join(f"{reason} {count}" for reason, count in failures.most_common(2)),
    ]


def rate(runs: list[Run]) -> float:
    """Trials a second."""
    return sum(len(r.result.success) for r in runs) / sum(r.seconds for r in runs)


def main() -> None:
    """Measure and print."""
    parser = options_of(__doc__)
    parser.add_argument("--full", action="store_true", help=f"{FULL} grasps a pair instead of {SAMPLE}")
    parser.add_argument("--seed", type=int, default=0, help="of the synthesis")
    parser.add_argument("--protocol", default=DEFAULT_PROTOCOL, choices=list(PROTOCOLS))
    parser.add_argument("--workers", type=int, default=cores(), help="threads")
    options = parser.parse_args()
    if "DRO_GRASP_ASSETS" not in os.environ:
        parser.error("set DRO_GRASP_ASSETS to the folder of the development assets")
    runs = {hand: measure(hand, options) for hand in HANDS}
    everything = [r for of_hand in runs.values() for r in of_hand]
    cpu = sum(r.cpu_seconds for r in everything) / sum(len(r.result.success) for r in everything)
    emit(
        f"Trials with protocol {options.protocol}: {FULL if options.full else SAMPLE} synthesized grasps (seed "
        f"{options.seed}) of each of the paper's 10 validation objects, {options.workers} threads",
        [row(hand, of_hand) for hand, of_hand in runs.items()],
        ["hand", "trials", "trials/s", "CPU [ms]", "slowest object", "there", "success [%]", "failures"],
        {"protocol": options.protocol, "trials_per_second": rate(everything), "per_hand": {h: rate(r) for h, r in runs.items()},
         "cpu_milliseconds_per_trial": cpu * 1e3, "workers": options.workers}, options.json,
    )


if __name__ == "__main__":
    main()
