"""Prediction and synthesis on a GPU, beside the processor in the same run.

Hands and objects are built in. Prediction is of candidates of the network alone, sixteen for each grasp that is returned: many
of one pair, some of many pairs of one hand, and the four of which one grasp is chosen, by stage, with settling and without. The
first run, which captures graphs, is told apart. Many pairs are of sixteen objects, each of which comes four times as an object
of its own. Synthesis is the optimiser's descent, without trials; shards are all of it, in one process: what is `strict`-valid
and confirmed, of training objects that are prepared before. Training is measured by `lab.benchmarks.training`, and all of it in
a few minutes by `lab.benchmarks.gpu_table`.

    python -m lab.benchmarks.device [--device cuda] [--only prediction,synthesis,shards] [--settled] [--alone] [--quick]
        [--record FILE] [--json]
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from dro_grasp.devices import require_device
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimize.synthesis import SynthesisConfig, synthesize
from dro_grasp.predict.config import GraspRequest, PredictorConfig, RetryConfig
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.finish import FinishConfig
from dro_grasp.predict.predictor import GraspPredictor, Prediction
from dro_grasp.predict.problem import problems_of
from dro_grasp.training.data.engine.worker import EngineConfig, Wanted, valid_grasps_of_all
from lab.benchmarks.report import emit, note, options_of

HAND, OBJECT = "allegro", "rubber_duck"
REPETITIONS = 5
ONE, MANY, SINGLE = "one pair", "many pairs", "one grasp"
PREDICTIONS = {"cpu": {ONE: (1, 2, 16), MANY: (4, 1, 4), SINGLE: (1, 1, 4)},
               "gpu": {ONE: (1, 64, 16), MANY: (64, 1, 16), SINGLE: (1, 1, 4)}}
"""Pairs, grasps of each, and candidates of each grasp."""
STAGES = ("network", "choose", "decode", "refine", "rank", "settle", "weigh")
ALL_AT_FIRST = RetryConfig(first=16)
"""All candidates are asked for at once, where half are by default as long as these suffice."""
SETTLED = (True, False)  # Whether candidates close in simulation
DISTINCT = 16  # Objects of which many pairs are made
DESCENTS = {"cpu": (128,), "gpu": (1024, 4096)}
SHARES = {"cpu": (1.0,), "gpu": (1.0, 0.1)}
"""Shares of what passes that the processor judges again; the first shard also compiles."""
SHARDS = {"cpu": 1, "gpu": 16}
"""Training objects of which a shard each is made."""
VALID = "strict"  # Protocol that grasps of a shard pass


def median(run: Callable[[], object], repetitions: int) -> float:
    """Seconds of a call, after one that is not counted."""
    times = []
    for _ in range(repetitions + 1):
        begin = time.perf_counter()
        run()
        times.append(time.perf_counter() - begin)
    return statistics.median(times[1:])


def objects(count: int) -> list[ObjectModel]:
    """Built-in training objects; where that is more than there are or more than DISTINCT, some come again."""
    if count == 1:
        return [load_object(OBJECT)]
    found = [load_object(name) for name in resolve_objects(["builtin:train"])[:DISTINCT]]
    with ThreadPoolExecutor() as pool:  # their distances are computed once
        fields = list(pool.map(lambda obj: obj.distance_field, found))
    again = []
    for i in range(count):
        obj = replace(found[i % len(found)])
        vars(obj)["distance_field"] = replace(fields[i % len(found)])
        again.append(obj)
    return again


class Run(NamedTuple):
    """What one prediction took."""

    seconds: float
    stages: dict[str, float]  # seconds of each
    made: int  # candidates, which may be fewer or more than were asked for


def predictions(device: str, repetitions: int, options: argparse.Namespace) -> list[list[object]]:
    """Rows of predictions: what, seconds of the first run, milliseconds of a candidate by stage, candidates made a second."""
    hand, rows = load_hand(HAND), []
    for settled in SETTLED[:1] if options.settled else SETTLED:
        finish = FinishConfig() if settled else FinishConfig(settle=None)
        predictor = GraspPredictor(device=device, config=PredictorConfig(finish=finish, retry=ALL_AT_FIRST))
        for name, (pairs, num, candidates) in PREDICTIONS[kind(device)].items():
            models = objects(pairs)
            request = GraspRequest(num, 0, candidates=candidates, source="network", least_confidence=0.0)
            # Closing in simulation takes most of the time, and is timed once.
            times = 1 if settled and pairs * num * candidates > SLOW else repetitions
            warm = 1 if times == 1 else WARM_RUNS
            runs = [one_run(predictor, hand, models, replace(request, seed=seed)) for seed in range(warm + times)]
            kept = runs[warm:]
            whole, count = (statistics.median(values) for values in ([run.seconds for run in kept], [run.made for run in kept]))
            parts = [1e3 * statistics.median(run.stages[name] for run in kept) / count for name in STAGES]
            what = f"{pairs} x {num} x {candidates}, {'settled' if settled else 'scored'}"
            note(options.record, f"{name}, {'settled' if settled else 'scored'}", device=device, rate=count / whole,
                 milliseconds=1e3 * whole, first=runs[0].seconds, candidates=count,
                 stages=dict(zip(STAGES, parts, strict=True)))
            rows.append(said([what, device, f"{runs[0].seconds:.2f}", *(f"{part:.3f}" for part in parts),
                              f"{1e3 * whole / count:.3f}", f"{count / whole:.1f}"]))
    return rows


def one_run(
    predictor: GraspPredictor, hand: Hand, models: list[ObjectModel], request: GraspRequest
) -> Run:
    """One prediction of all objects."""
    begin = time.perf_counter()
    made = predictor.run_many(problems_of(hand, models, predictor.device, Constraints()), request)
    whole = time.perf_counter() - begin
    found = [one for one in made if isinstance(one, Prediction)]
    return Run(whole, {name: sum(one.seconds[name] for one in found) for name in STAGES}, sum(one.candidates for one in found))


SLOW = 100  # Candidates from which on closing in simulation is timed once
WARM_RUNS = 2  # Predictions that are not counted


def descents(device: str, repetitions: int) -> list[list[object]]:
    """Rows of the optimiser: how many at once, and milliseconds of one candidate."""
    hand, obj, rows = load_hand(HAND), load_object(OBJECT), []
    config = SynthesisConfig(device=device)
    for num in DESCENTS[kind(device)]:
        seconds = median(lambda num=num: synthesize(hand, obj, num, 0, config), repetitions)
        rows.append(said([f"synthesis, {num} candidates", device, *BLANK, f"{1e3 * seconds / num:.3f}", num / seconds]))
    return rows


def shards(device: str, options: argparse.Namespace) -> list[list[object]]:
    """Rows of whole shards, which one process makes and confirms: candidates, and valid grasps a second."""
    hand, names, rows = load_hand(HAND), resolve_objects(["builtin:train"]), []
    models = [load_object(name) for name in names[::len(names) // SHARDS[kind(device)]][:SHARDS[kind(device)]]]
    _ = [(obj.distance_field, obj.parts) for obj in models]
    for share in SHARES[kind(device)]:
        config = EngineConfig(protocol=VALID, confirm=share, synthesis=SynthesisConfig(device=device)).suited()
        begin = time.perf_counter()
        wanted = [Wanted(obj, 0, config.candidates) for obj in models]
        made = [one for first in range(0, len(wanted), config.together)
                for _, one in valid_grasps_of_all(hand, wanted[first:first + config.together], config)]
        seconds = time.perf_counter() - begin
        count, valid, judged, judging = (
            sum(getattr(one, name) for one in made) for name in ("candidates", "valid", "judged", "judging_seconds"))
        note(options.record, f"shard, {share:g} confirmed", device=device, rate=valid / seconds, valid=valid, candidates=count,
             judged=judged, judging=judging / seconds, seconds=seconds, objects=[obj.name for obj in models], protocol=VALID)
        what = f"shards: {len(models)}, {count} candidates, {judged} of {valid} confirmed"
        rows.append(said([what, device, *BLANK, f"{1e3 * seconds / count:.3f}", valid / seconds]))
    return rows


def said(row: list[object]) -> list[object]:
    """The row, which is also printed at once: the whole takes minutes."""
    print(*row, file=sys.stderr, flush=True)
    return row


def kind(device: str) -> str:
    """Which of the lists above a device has."""
    return "cpu" if device == "cpu" else "gpu"


def main() -> None:
    """Measure and print."""
    parser = options_of(__doc__)
    parser.add_argument("--device", default="cuda", help="what is compared with the processor")
    parser.add_argument("--only", default="prediction,synthesis,shards", help="what is measured, by commas")
    parser.add_argument("--settled", action="store_true", help="predictions with settling alone")
    parser.add_argument("--alone", action="store_true", help="leave out the processor")
    parser.add_argument("--quick", action="store_true", help="one repetition")
    parser.add_argument("--record", type=Path, help="file to which each result is appended as it is found")
    options = parser.parse_args()
    require_device(options.device)
    repetitions, only = 1 if options.quick else REPETITIONS, options.only.split(",")
    rows: list[list[object]] = []
    for device in dict.fromkeys((options.device, *(() if options.alone else ("cpu",)))):
        if "prediction" in only:
            rows += predictions(device, repetitions, options)
        if "synthesis" in only:
            rows += descents(device, repetitions)
        if "shards" in only:
            rows += shards(device, options)
    emit(
        f"{HAND} and {OBJECT}, or 64 objects; pairs x grasps x candidates: median of {repetitions}; milliseconds for each "
        "candidate", rows, ["what", "device", "first run [s]", *STAGES, "whole", "a second"],
        {f"{what} {device}": float(str(rate)) for what, device, *_, rate in rows}, options.json,
    )


BLANK = [""] * (1 + len(STAGES))  # Columns that only predictions have


if __name__ == "__main__":
    main()
