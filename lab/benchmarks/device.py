"""Prediction, synthesis and training on a GPU, beside the processor in the same run.

Hands and objects are built in. Everything is timed once it is warm. Prediction is `generate` with candidates of the network
alone; trials always run on the processor and are not part of it. The paper-size network has random weights, whose distances fit
no grasp, so its decoding takes longer than that of a trained one. Synthesis is the optimiser's descent, without trials.
Training is a step of the preset with its own number of object points, in bfloat16 where `--mixed` would be given.

    python -m lab.benchmarks.device [--device cuda] [--bundle FILE] [--quick] [--json]
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from dro_grasp.devices import require_device
from dro_grasp.hands.library import load_hand
from dro_grasp.network.checkpoints import DEFAULT, save_weights
from dro_grasp.network.network import untrained_network
from dro_grasp.network.presets import NetworkConfig
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimize.synthesis import SynthesisConfig, synthesize
from dro_grasp.predict.config import GraspRequest
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.training.config import ScheduleConfig, TrainConfig
from dro_grasp.training.data.bundle.training_file import Bundle, load_bundle
from dro_grasp.training.loop import train
from lab.benchmarks.report import emit

HAND, OBJECT = "allegro", "rubber_duck"
REPETITIONS = 3
PREDICTIONS = {"cpu": (1, 16), "gpu": (1, 16, 256)}
DESCENTS = {"cpu": (128,), "gpu": (128, 1024, 4096)}
BATCHES = {"cpu": ((4, 4),), "gpu": ((4, 4), (8, 32), (8, 128))}
"""Hands a step and samples of each."""
TRAINED = {"multi": (48, False), "paper": (128, True)}
"""Presets, the object points of a step, and whether a GPU multiplies in bfloat16."""
STEPS = {"cpu": 4, "gpu": 10}
WARM_UP = 2
"""Steps that are not counted."""


def median(run: Callable[[], object], repetitions: int) -> float:
    """Seconds of a call, after one that is not counted."""
    times = []
    for _ in range(repetitions + 1):
        begin = time.perf_counter()
        run()
        times.append(time.perf_counter() - begin)
    return statistics.median(times[1:])


def predictions(device: str, weights: dict[str, str], repetitions: int) -> list[list[object]]:
    """Rows of predictions: what, how many at once, and seconds of each part for one."""
    hand, obj, rows = load_hand(HAND), load_object(OBJECT), []
    for label, path in weights.items():
        predictor = GraspPredictor(path, device)
        for num in PREDICTIONS[kind(device)]:
            parts: list[dict[str, float]] = []

            def run(predictor: GraspPredictor = predictor, num: int = num, parts: list[dict[str, float]] = parts) -> None:
                request = GraspRequest(num, len(parts), candidates=1, source="network", least_confidence=0.0)
                parts.append(dict(predictor.run(GraspProblem(hand, obj, device), request).seconds))

            whole = median(run, repetitions)
            network = statistics.median(p["network"] + p["choose"] + p["decode"] for p in parts[1:])
            rows.append(said([f"prediction, {label}", device, num, 1e3 * whole / num, 1e3 * network / num, num / whole]))
    return rows


def descents(device: str, repetitions: int) -> list[list[object]]:
    """Rows of the optimiser: how many at once, and milliseconds of one candidate."""
    hand, obj, rows = load_hand(HAND), load_object(OBJECT), []
    config = SynthesisConfig(device=device)
    for num in DESCENTS[kind(device)]:
        seconds = median(lambda num=num: synthesize(hand, obj, num, 0, config), repetitions)
        rows.append(said(["synthesis, candidates", device, num, 1e3 * seconds / num, "", num / seconds]))
    return rows


def training(device: str, bundle: Bundle) -> list[list[object]]:
    """Rows of training steps: samples of a step, and samples a second."""
    rows = []
    for preset, (columns, mixed) in TRAINED.items():
        network = NetworkConfig.preset(preset)
        for hands, samples in BATCHES[kind(device)]:
            schedule = ScheduleConfig(
                steps=STEPS[kind(device)], device=device, log_every=1, recalibration=1, mixed=mixed and kind(device) == "gpu")
            with tempfile.TemporaryDirectory() as folder:
                config = TrainConfig(schedule, hands_per_step=hands, samples_per_hand=samples, columns=columns)
                train(bundle, network, config, Path(folder), report=lambda *_: None)
                seconds = [json.loads(line)["seconds"] for line in (Path(folder) / "log.jsonl").read_text().splitlines()]
            step = (seconds[-1] - seconds[WARM_UP - 1]) / (len(seconds) - WARM_UP)
            count = hands * samples
            rows.append(said([f"training, {preset}", device, count, 1e3 * step / count, "", count / step]))
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda", help="what is compared with the processor")
    parser.add_argument("--bundle", type=Path, help="training bundle, for the speed of training")
    parser.add_argument("--quick", action="store_true", help="one repetition")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    require_device(options.device)
    repetitions = 1 if options.quick else REPETITIONS
    rows: list[list[object]] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "paper.safetensors"
        save_weights(untrained_network(NetworkConfig.preset("paper"), 0, "paper"), path)
        for device in dict.fromkeys(("cpu", options.device)):
            rows += predictions(device, {"default weights": DEFAULT, "paper size": str(path)}, repetitions)
            rows += descents(device, repetitions)
            if options.bundle:
                rows += training(device, load_bundle(options.bundle))
    emit(
        f"{HAND} and {OBJECT}: median of {repetitions}; times for each grasp, candidate or sample", rows,
        ["what", "device", "at once", "[ms]", "network and decoding [ms]", "a second"],
        {f"{what} {device} {num}": float(str(rate)) for what, device, num, *_, rate in rows}, options.json,
    )


if __name__ == "__main__":
    main()
