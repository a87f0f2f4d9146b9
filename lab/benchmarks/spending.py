"""Computing time of a returned grasp with its candidates, and how many of those that were asked for hold.

Time is that of the process, in one thread, from loaded hand and object to weighed grasps, scenes included; the first pair is
run once before, uncounted. With --against, the code of another checkout takes turns with this one, pair by pair.

    python -m lab.benchmarks.spending [--hands H ...] [--objects O ...] [--num 16] [--against FOLDER/src] [--json]
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import statistics
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import TypedDict

import torch

import dro_grasp
from dro_grasp.errors import NoGraspError
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.config import GraspRequest
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.simulation.trial import simulate
from lab.benchmarks.report import ROOT, emit, rate

HANDS = ("barrett", "assets/allegro_left", "gripper3", "assets/leaphand", "assets/shadowhand")
OBJECTS = ("bowl", "egg", "kettlebell", "light_bulb", "contactdb+camera", "cross", "toy_airplane", "tall_box")
"""Of training and validation; by the others of them what is spent was chosen."""
PROTOCOLS = ("carry", "dexgraspbench")
HERE = Path(dro_grasp.__file__).parents[1]


class Answer(TypedDict):
    """What became of one pair."""

    seconds: float
    returned: int
    candidates: int
    held: list[int]  # grasps that hold under each of PROTOCOLS


def answer(predictor: GraspPredictor, hand: Hand, obj: ObjectModel, num: int, seed: int) -> Answer:
    """Predict and try."""
    problem, begin = GraspProblem(hand, obj), time.process_time()
    try:
        made = predictor.run(problem, GraspRequest(num, seed))
    except NoGraspError:
        return Answer(seconds=time.process_time() - begin, returned=0, candidates=0, held=[0] * len(PROTOCOLS))
    seconds = time.process_time() - begin
    held = [int(simulate(hand, obj, made.grasps, name, workers=1).success.sum()) for name in PROTOCOLS]
    return Answer(seconds=seconds, returned=len(made.grasps), candidates=made.candidates, held=held)


def work() -> None:
    """Answer one request a line, until there are no more."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    predictor, hands = GraspPredictor(), cache(load_hand)
    for line in sys.stdin:
        hand, obj, num, seed = json.loads(line)
        print(json.dumps(answer(predictor, hands(hand), load_object(obj), num, seed)), flush=True)


@contextmanager
def worker(source: Path) -> Iterator[subprocess.Popen[str]]:
    """A process with the code of a folder `src`, which ends with the block."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(source), str(ROOT)]), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "lab.benchmarks.spending", "--work"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment, cwd=ROOT) as one:
        try:
            yield one
        finally:
            assert one.stdin is not None
            one.stdin.close()


def asked(one: subprocess.Popen[str], hand: str, obj: str, num: int, seed: int) -> Answer:
    """What a worker answers."""
    assert one.stdin is not None
    assert one.stdout is not None
    print(json.dumps([hand, obj, num, seed]), file=one.stdin, flush=True)
    return json.loads(one.stdout.readline())


def row(name: str, found: list[Answer], num: int) -> list[object]:
    """Means over pairs, and success of all grasps that were asked for."""
    total, returned = num * len(found), sum(one["returned"] for one in found)
    held = [sum(one["held"][i] for one in found) for i in range(len(PROTOCOLS))]
    seconds = [one["seconds"] for one in found]
    each = statistics.median(s / one["returned"] for s, one in zip(seconds, found, strict=True) if one["returned"])
    made = sum(one["candidates"] for one in found) / total
    return [name, len(found), 1e3 * sum(seconds) / max(returned, 1), 1e3 * each, made, f"{returned} of {total}",
            *(rate([True] * count, total) for count in held)]


COLUMNS = ("code", "pairs", "mean [ms]", "median pair [ms]", "candidates each", "returned", *(f"{p} [%]" for p in PROTOCOLS))
"""Times are of a returned grasp; success is of those that were asked for."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hands", nargs="+", default=HANDS)
    parser.add_argument("--objects", nargs="+", default=OBJECTS)
    parser.add_argument("--num", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--against", type=Path, help="folder `src` of another checkout")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work:
        work()
        return
    sources = {"this": HERE} | ({"other": options.against.resolve()} if options.against else {})
    found: dict[str, list[Answer]] = {name: [] for name in sources}
    with ExitStack() as stack:
        workers = {name: stack.enter_context(worker(source)) for name, source in sources.items()}
        for one in workers.values():
            asked(one, options.hands[0], options.objects[0], 1, 1)
        for obj, hand in itertools.product(options.objects, options.hands):
            for name, one in workers.items():
                found[name].append(asked(one, hand, obj, options.num, options.seed))
                print(hand, obj, name, found[name][-1], file=sys.stderr, flush=True)
    rows = [row(name, answers, options.num) for name, answers in found.items()]
    emit(f"{options.num} grasps of {len(options.hands)} hands and {len(options.objects)} objects, one thread", rows, COLUMNS,
         {str(one[0]): dict(zip(COLUMNS[1:], one[1:], strict=True)) for one in rows}, options.json)


if __name__ == "__main__":
    main()
