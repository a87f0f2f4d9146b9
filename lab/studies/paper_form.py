"""The paper's own form, trained with and without pretraining of the hand encoder, over several seeds.

    python -m lab.studies.paper_form --bundle BUNDLE --output FOLDER [--rows ROW ...] [--seeds N ...] [--steps N] [--json]

Both clouds in the object's axes, the hand zero-centred and tilted by 0 to 30 degrees, z from N(0, I) into the kernel alone,
and the losses of the official release; wrists are turned at random at inference. Seeds are trained in turn, each with every
row. A rerun resumes the training that was interrupted and skips what the folder holds, so rows and seeds may be added.
Needs the development assets by default.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, stdev
from typing import Any

import torch

from dro_grasp.compare.methods import Method
from dro_grasp.compare.metrics import wilson_interval
from dro_grasp.compare.rows import ALL
from dro_grasp.compare.stages import BEST, RAW, REFINED, BenchmarkConfig, benchmark
from dro_grasp.files import replacing
from dro_grasp.hands.library import load_hand
from dro_grasp.network.checkpoints import describe_weights, load_weights, save_weights
from dro_grasp.network.presets import NetworkConfig
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.simulation.protocols import protocol
from dro_grasp.training.config import LOSSES, LossConfig, PretrainConfig, ScheduleConfig, TrainConfig
from dro_grasp.training.data.bundle.training_file import Bundle, load_bundle
from dro_grasp.training.loop import train
from dro_grasp.training.measures import distance_errors
from dro_grasp.training.pretraining import pretrain
from dro_grasp.training.runs import how_long
from lab.benchmarks.report import emit, options_of
from lab.benchmarks.synthesis import HANDS

PROTOCOLS = ("dro", "strict")
"""Trials of every grasp."""
STAGES = (RAW, REFINED, BEST)
"""What is done to the grasps before the trials."""


@dataclass(frozen=True)
class Form:
    """One way to train the paper's network."""

    pretrained: bool
    """Whether the hand encoder is pretrained, and frozen then; otherwise it is trained along."""
    losses: LossConfig = LOSSES["release"]


PRETRAINED, PLAIN = "pretrained", "not pretrained"
ROWS = {
    PRETRAINED: Form(True),
    PLAIN: Form(False),
    "pretrained, KL 0.0003": Form(
        True, dataclasses.replace(LOSSES["release"], divergence=0.0003, divergence_form="batch_mean")),
}
"""Rows by name. The last lets z carry more: its divergence is the mean over the batch, with a small weight."""


def part(bundle: Bundle, hands: Sequence[str]) -> Bundle:
    """The grasps of some hands of a bundle."""
    return Bundle({name: bundle.hands[name] for name in hands}, bundle.objects, {name: bundle.grasps[name] for name in hands})


def label(options: argparse.Namespace, row: str, seed: int) -> str:
    """Name of the files of a row with a seed."""
    return f"{options.preset}_{row.replace(' ', '_')}_{options.steps}_{seed}"


def trained(options: argparse.Namespace, row: str, seed: int, bundle: Bundle) -> Path:
    """The weights of a row, trained now unless the folder holds them."""
    form, folder = ROWS[row], options.output
    path = folder / f"{label(options, row, seed)}.safetensors"
    if path.exists():
        return path
    network = NetworkConfig.preset(options.preset)
    schedule = ScheduleConfig(steps=options.steps, device=options.device, seed=seed)
    first, seconds = None, 0.0
    if form.pretrained:
        before = PretrainConfig(dataclasses.replace(schedule, steps=options.pretraining_steps))
        place = folder / f"{options.preset}_pretraining_{seed}"
        first = pretrain(bundle, network, before, place)
        seconds = how_long(place)["seconds"]
    config = TrainConfig(schedule, form.losses)
    model = train(bundle, network, config, folder / path.stem, first, name=path.stem)
    about = {
        "stage": "training", "pretrained": form.pretrained, "steps": options.steps, "data": bundle.summary(),
        "seconds": seconds + how_long(folder / path.stem)["seconds"], "settings": dataclasses.asdict(config),
    }
    save_weights(model, path, about)
    return path


def measured(options: argparse.Namespace, row: str, seed: int, bundle: Bundle) -> dict[str, Any]:
    """Train and evaluate a row with a seed, unless the folder holds the result."""
    where = "+".join(options.objects).replace(":", "-").replace("/", "-")
    stored = options.output / f"{label(options, row, seed)}_on_{where}_{options.num}.json"
    if not stored.exists():
        weights = trained(options, row, seed, bundle)
        objects = [load_object(name) for name in resolve_objects(options.objects)]
        config = BenchmarkConfig(options.num, STAGES, tuple(map(protocol, PROTOCOLS)), seed=seed, workers=1)
        methods = [Method("network", GraspPredictor(str(weights)))]
        rows = benchmark([load_hand(h) for h in options.hands], objects, methods, config)
        errors = []
        if options.validation is not None:
            errors = distance_errors(load_weights(weights), part(load_bundle(options.validation), options.hands))
        values = {
            "row": row, "seed": seed, "seconds": describe_weights(weights)["about"]["seconds"],
            "rows": [r.to_dict() for r in rows], "errors": [dataclasses.asdict(e) for e in errors],
        }
        with replacing(stored) as temporary:
            temporary.write_text(json.dumps(values))
    return json.loads(stored.read_text())


def cells(results: Sequence[dict[str, Any]]) -> list[list[object]]:
    """Lines of a row: success of each stage and hand over all seeds, and on average that of each seed in brackets."""
    lines: list[list[object]] = []
    grouped: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for line in (line for result in results for line in result["rows"]):
        grouped.setdefault((line["stage"], line["hand"]), []).append(line)
    for (stage, hand), seeds in grouped.items():
        total = sum(line["num"] for line in seeds)
        rates = []
        for name in seeds[0]["success"]:
            each = [line["success"][name][0] for line in seeds]
            low, high = wilson_interval(round(mean(each) * total), total)
            alone = f" ({', '.join(f'{100 * r:.1f}' for r in each)})" if hand == ALL and len(each) > 1 else ""
            rates.append(f"{100 * mean(each):.1f} [{100 * low:.0f}-{100 * high:.0f}]{alone}")
        lines.append([
            results[0]["row"], stage, hand, len(seeds), total, *rates, f"{mean(line['diversity'] for line in seeds):.3f}"])
    return lines


def note(results: Sequence[dict[str, Any]]) -> str:
    """What the training of a row took, and what z carries, mean over seeds and hands."""
    told = f"{results[0]['row']}: {mean(r['seconds'] for r in results) / 60:.0f} minutes of training a seed"
    if errors := [error for result in results for error in result["errors"]]:
        posterior, prior, nats = (mean(e[n] for e in errors) for n in ("posterior", "prior", "divergence"))
        told += f"; validate grasps: posterior {1e3 * posterior:.1f} mm, prior {1e3 * prior:.1f} mm, z carries {nats:.2g} nat"
    return told


def averages(result: dict[str, Any]) -> dict[tuple[str, str], float]:
    """Success over all hands by stage and protocol; the last line of a stage is the average."""
    return {(line["stage"], name): rate[0] for line in result["rows"] for name, rate in line["success"].items()}


def gains(pretrained: Sequence[dict[str, Any]], plain: Sequence[dict[str, Any]]) -> list[str]:
    """What pretraining adds on average over hands, for each stage and protocol, by seeds that have both."""
    pairs = [(averages(a), averages(b)) for a in pretrained for b in plain if a["seed"] == b["seed"]]
    lines = []
    for stage, name in pairs[0][0] if pairs else ():
        points = [100 * (a[stage, name] - b[stage, name]) for a, b in pairs]
        middle, margin = mean_and_margin(points)
        each = ", ".join(f"{value:+.1f}" for value in points)
        sure = f"+- {margin:.1f} points (by seed {each})" if len(points) > 1 else "points (one seed)"
        lines.append(f"pretraining adds under {name}, {stage}: {middle:+.1f} {sure}")
    return lines


def mean_and_margin(values: Sequence[float]) -> tuple[float, float]:
    """The mean, and half of its 95 % interval by Student's t; NaN for a single value."""
    from scipy.stats import t

    if len(values) == 1:
        return values[0], math.nan
    return mean(values), float(t.ppf(0.975, len(values) - 1)) * stdev(values) / math.sqrt(len(values))


def main(argv: Sequence[str] | None = None) -> None:
    """Train, evaluate and print."""
    parser = options_of(__doc__)
    parser.add_argument("--bundle", type=Path, required=True, help="training bundle that holds the hands")
    parser.add_argument("--validation", type=Path, help="validate bundle, for the errors of distances")
    parser.add_argument("--output", type=Path, required=True, help="folder for runs, weights and results")
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=[PRETRAINED, PLAIN], help="rows to train")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="seeds of weights and samples")
    parser.add_argument("--preset", default="paper-slim", choices=["paper-slim", "paper"], help="width of the network")
    parser.add_argument("--steps", type=int, default=8000, help="training steps of 16 samples")
    parser.add_argument("--pretraining-steps", type=int, default=3000, help="steps of 16 pairs before them")
    parser.add_argument("--device", default="cpu", help="where to train")
    parser.add_argument("--hands", nargs="+", default=list(HANDS), help="hands of training and trials")
    parser.add_argument("--objects", nargs="+", default=["assets:validate"], help="objects of the trials")
    parser.add_argument("--num", type=int, default=40, help="grasps of each hand on each object and seed")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    options.output.mkdir(parents=True, exist_ok=True)
    bundle = part(load_bundle(options.bundle), options.hands)
    found: dict[str, list[dict[str, Any]]] = {}
    for seed in options.seeds:
        for row in options.rows:
            found.setdefault(row, []).append(measured(options, row, seed, bundle))
    columns = ["row", "stage", "hand", "seeds", "n", *(f"{name} [%]" for name in PROTOCOLS), "diversity"]
    notes = [*map(note, found.values()), *gains(found.get(PRETRAINED, []), found.get(PLAIN, []))]
    emit(f"'{options.preset}', {options.steps} steps of 16 samples, {options.num} grasps of each hand on each of "
         f"{' '.join(options.objects)} and seed", [line for results in found.values() for line in cells(results)], columns,
         {**found, **{str(i): told for i, told in enumerate(notes, 1)}}, options.json)


if __name__ == "__main__":
    main()
