"""Time of one grasp, and of one of sixteen, from loaded hand and object to joints, pregrasp and score.

The paper-size network has random weights. Its distances fit no grasp, so the joint solver needs more steps and its times are
an upper bound. "default" are the weights that `generate` takes. Each number is the median over hands and repetitions, after
one prediction that is not counted. Loading of hands, objects and weights is not counted either. Single grasps, and with
--full all, are measured twice: alone, as far as the machine is, and beside two processes that compute all the time. Threads
wait as the commands let them, asleep.

    python -m lab.benchmarks.inference [--json] [--full] [--threads N] [--seed 0]
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from dro_grasp.cli.main import WAIT_POLICY
from dro_grasp.devices import cores
from dro_grasp.hands.library import load_hand
from dro_grasp.network.checkpoints import save_weights
from dro_grasp.network.network import DistanceNetwork
from dro_grasp.network.presets import NetworkConfig
from dro_grasp.objects.catalogue import load_object
from dro_grasp.predict.config import GraspRequest
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from lab.benchmarks.report import emit, options_of

HANDS = ("barrett", "allegro", "shadowhand")
"""Built-in versions of the paper's hands."""
OBJECT = "rubber_duck"
RUNS, FULL = 3, 15
PARTS = ("network", "choose", "decode", "refine", "settle", "rank", "weigh")
OTHERS = {"quiet": 0, "busy": 2}
"""Processes that compute beside the measurement."""


def paper_size(folder: Path, seed: int) -> Path:
    """Weights of the paper's size, untrained."""
    torch.manual_seed(seed)
    path = folder / "paper_size.safetensors"
    save_weights(DistanceNetwork(NetworkConfig.preset("paper")), path)
    return path


@contextmanager
def busy(others: int) -> Iterator[None]:
    """So many other processes compute while the block lasts."""
    spin = [sys.executable, "-c", "while True: pass"]
    processes = [subprocess.Popen(spin, start_new_session=True) for _ in range(others)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def measure(predictor: GraspPredictor, num: int, runs: int, seed: int) -> dict[str, list[float]]:
    """Seconds of every prediction, whole and in parts."""
    obj, times = load_object(OBJECT), defaultdict(list)
    for name in HANDS:
        hand = load_hand(name)
        predictor.predict(hand, obj, num, seed, candidates=1, source="network", least_confidence=0.0)
        for run in range(runs):
            begin = time.perf_counter()
            made = predictor.run(GraspProblem(hand, obj), GraspRequest(
                num, seed + run, candidates=1, source="network", least_confidence=0.0))
            times["whole"].append(time.perf_counter() - begin)
            for part in PARTS:
                times[part].append(made.seconds[part])
    return times


def main() -> None:
    """Measure and print."""
    parser = options_of(__doc__)
    parser.add_argument("--full", action="store_true", help=f"{FULL} runs a hand, not {RUNS}; 16 grasps busy too")
    parser.add_argument("--threads", type=int, default=cores())
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    runs = FULL if options.full else RUNS
    rows, seconds, slowest = [], {}, {}
    with tempfile.TemporaryDirectory() as folder:
        predictors = {"paper": GraspPredictor(str(paper_size(Path(folder), options.seed))), "default": GraspPredictor()}
    for load, others in OTHERS.items():
        for size, predictor in predictors.items():
            for num in (1, 16) if options.full or not others else (1,):
                with busy(others):
                    times = measure(predictor, num, runs, options.seed)
                median = {key: statistics.median(values) for key, values in times.items()}
                seconds[load, size, num], slowest[load, size, num] = median["whole"], max(times["whole"])
                parameters = sum(p.numel() for p in predictor.network.parameters()) / 1e6
                rows.append([f"{size}, {parameters:.1f} M parameters", load, num, 1e3 * median["whole"] / num,
                             *(1e3 * median[part] / num for part in PARTS), 1e3 * max(times["whole"]) / num])
    emit(
        f"Grasps of {OBJECT} with {', '.join(HANDS)}: median of {runs * len(HANDS)} predictions, {options.threads} "
        f"thread(s), seed {options.seed}; times per grasp",
        rows, ["network", "machine", "grasps", "whole [ms]", *(f"{part} [ms]" for part in PARTS), "slowest [ms]"],
        {
            "latency_paper": seconds["quiet", "paper", 1], "latency_default": seconds["quiet", "default", 1],
            "batch16_per_grasp_paper": seconds["quiet", "paper", 16] / 16,
            "batch16_per_grasp_default": seconds["quiet", "default", 16] / 16,
            "busy_over_quiet": {f"{size} {num}": value / seconds["quiet", size, num]
                                for (load, size, num), value in seconds.items() if load == "busy"},
            "busy_longest_over_median": {f"{size} {num}": slowest[load, size, num] / value
                                         for (load, size, num), value in seconds.items() if load == "busy"},
            "threads": options.threads,
        }, options.json,
    )


if __name__ == "__main__":
    if WAIT_POLICY[0] not in os.environ:  # it counts only before PyTorch is loaded
        os.execve(sys.executable, sys.orig_argv, os.environ | dict([WAIT_POLICY]))
    main()
