"""Time of a returned grasp with all candidates that it took, by `predict` with its defaults.

From loaded hand and object to grasps with pregrasp, squeeze and score. Each pair of a hand and a training object is predicted
with some seeds, after one prediction that is not counted; the numbers are medians over pairs, of the median over seeds. Threads
wait as the commands let them, asleep. `lab.benchmarks.inference` tells of the parts.

    python -m lab.benchmarks.returned [--num 1 16] [--hands H ...] [--objects O ...] [--seeds 3] [--json]
"""

from __future__ import annotations

import os
import statistics
import sys
import time

from dro_grasp.cli.main import WAIT_POLICY
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.predict.config import GraspRequest
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from lab.benchmarks.report import emit, options_of

HANDS = ("allegro", "barrett")
OBJECTS = ("bottle", "can", "torus")


def measure(predictor: GraspPredictor, hand: str, obj: str, num: int, seeds: int) -> tuple[float, int, int]:
    """Median seconds of a returned grasp, and how many grasps and candidates there were with all seeds."""
    models, times, returned, candidates = (load_hand(hand), load_object(obj)), [], 0, 0
    predictor.run(GraspProblem(*models), GraspRequest(num, seeds))
    for seed in range(seeds):
        begin = time.perf_counter()
        made = predictor.run(GraspProblem(*models), GraspRequest(num, seed))
        times.append((time.perf_counter() - begin) / len(made.grasps))
        returned, candidates = returned + len(made.grasps), candidates + made.candidates
    return statistics.median(times), returned, candidates


def main(argv: list[str] | None = None) -> None:
    """Measure and print."""
    parser = options_of(__doc__)
    parser.add_argument("--num", nargs="+", type=int, default=[1, 16], help="grasps of a prediction")
    parser.add_argument("--hands", nargs="+", default=list(HANDS))
    parser.add_argument("--objects", nargs="+", default=list(OBJECTS))
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args(argv)
    predictor, rows, seconds = GraspPredictor(), list[list[object]](), dict[str, float]()
    for num in options.num:
        found = {(hand, obj): measure(predictor, hand, obj, num, options.seeds)
                 for hand in options.hands for obj in options.objects}
        rows += [[num, *pair, 1e3 * each, returned, made] for pair, (each, returned, made) in found.items()]
        seconds[str(num)] = statistics.median(each for each, *_ in found.values())
    emit(f"A returned grasp: median of {options.seeds} seeds", rows,
         ["asked", "hand", "object", "a grasp [ms]", "returned", "candidates"],
         {"seconds_a_grasp": seconds, **{f"one of {num} [ms]": 1e3 * each for num, each in seconds.items()}}, options.json)


if __name__ == "__main__":
    if WAIT_POLICY[0] not in os.environ:  # it counts only before PyTorch is loaded
        os.execve(sys.executable, sys.orig_argv, os.environ | dict([WAIT_POLICY]))
    main()
