"""Ablations of training: the slim network, trained anew for every row on equally many samples, then evaluated.

    python benchmarks/ablations.py --output FOLDER [--rows ROW ...] [--steps N] [--num N] [--objects NAME ...]
        [--picture FILE.png] [--json]

Rows are trained in turn and stored in the folder. A rerun, with more rows or after an interruption, does only the missing
ones; two runs with different rows may share a folder. Every pair of a hand and an object gets the same number of grasps.
`--objects builtin:test` evaluates on objects by which no configuration was chosen. `--picture` draws success against the number
of training grasps, of those of the rows that have one. Needs the development assets.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from report import ROOT, emit
from synthesis import HANDS

from dro_grasp.baselines.ours import DistanceMethod
from dro_grasp.cli.main import main as command
from dro_grasp.datasets.bundle.training_file import HELD_OUT_HANDS, Bundle, load_bundle
from dro_grasp.evaluation.distance_error import distance_errors
from dro_grasp.evaluation.metrics import wilson_interval
from dro_grasp.evaluation.rows import ALL
from dro_grasp.evaluation.success_rates import RAW, REFINED, BenchmarkConfig, benchmark
from dro_grasp.hands.library import load_hand
from dro_grasp.models.checkpoints import history_of, load_weights, locate_weights, save_weights
from dro_grasp.models.network import DistanceNetwork
from dro_grasp.models.presets import NetworkConfig
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.perception.partial_views import View
from dro_grasp.predictor import GraspPredictor
from dro_grasp.simulation.protocols import protocol
from dro_grasp.training.config import (
    AugmentationConfig,
    LossConfig,
    MotionConfig,
    PretrainConfig,
    ScheduleConfig,
    TrainConfig,
)
from dro_grasp.training.loop import train
from dro_grasp.training.pretraining import pretrain, pretrain_motion

HELD_OUT = tuple(sorted(HELD_OUT_HANDS))
FEW_SHOT = ("assets/inspire", "assets/dclaw", "assets/orca")
OTHERS = ("assets/leaphand", "assets/allegro_right", "allegro", "barrett", "gripper3", "leaphand", "shadowhand")
PER_PAIR = 100
"""Grasps of a hand on an object in the bundles."""
PRETRAINING_STEPS, MOTION_STEPS = 1000, 1000


@dataclass(frozen=True)
class Ablation:
    """One training."""

    hands: tuple[str, ...] = HANDS
    """Hands trained on."""
    evaluated: tuple[str, ...] = HANDS
    """Hands that the weights are evaluated with."""
    pretrained: bool = True
    network: dict[str, Any] = field(default_factory=dict)
    """Settings that differ from the slim network's."""
    losses: LossConfig = field(default_factory=LossConfig)
    partial: float = 0.0
    fine_tuned: bool = False
    """The shipped weights are trained further, instead of new ones."""
    grasps: int | None = None
    """Grasps of each hand, over all objects, that are trained on; all by default."""
    pretrained_as: str | None = None
    """Row whose pretrained encoder and motion are taken; they saw hands in all grasps' postures, without objects."""
    share: float = 1.0
    """Share of the steps of the other rows."""
    view: View = "whole"


MOTION = {"latent_form": "motion", "latent": 32}
ROWS = {
    "three hands": Ablation(),
    "without pretraining": Ablation(pretrained=False),
    "barrett alone": Ablation(hands=HANDS[:1]),
    "allegro alone": Ablation(hands=HANDS[1:2]),
    "shadow alone": Ablation(hands=HANDS[2:]),
    "half clouds": Ablation(partial=1.0, view="half"),
    "z: official divergence": Ablation(losses=LossConfig(divergence=0.001, divergence_form="official")),
    "z: divergence 0.0003": Ablation(losses=LossConfig(divergence=0.0003)),
    "z: warm-up, free bits": Ablation(losses=LossConfig(divergence_warmup=0.5, free_bits=0.1)),
    "z: learned prior": Ablation(network={"prior": "learned"}, losses=LossConfig(divergence=0.0003)),
    "z: flow": Ablation(network={"prior": "flow"}, losses=LossConfig(divergence=0.0003)),
    "z: motion, flow": Ablation(network={"prior": "flow", **MOTION}, losses=LossConfig(divergence=0.0003)),
    "z: motion, flow, 0.001": Ablation(network={"prior": "flow", **MOTION}, losses=LossConfig(divergence=0.001)),
    **{
        f"z: motion, flow, {count} grasps a hand": Ablation(
            network={"prior": "flow", **MOTION}, losses=LossConfig(divergence=0.0003), grasps=count,
            pretrained_as="z: motion, flow")
        for count in (3, 10, 40)
    },
    "ten hands, wrist axes": Ablation(hands=(*HANDS, *OTHERS), evaluated=HELD_OUT, network={"frame": "wrist"}),
    "ten hands, palm axes": Ablation(hands=(*HANDS, *OTHERS), evaluated=HELD_OUT),
    **{
        f"{hand.split('/')[1]}, {count} grasps": Ablation(
            hands=(hand,), evaluated=(hand,), fine_tuned=True, grasps=count, share=0.3)
        for hand in FEW_SHOT for count in (0, 50, 200, 1000)
    },
}


def bundle_of(ablation: Ablation, folder: Path) -> Bundle:
    """All training grasps of the row's hands, made once for all rows that share them."""
    split = "few_shot" if set(ablation.hands) <= set(HELD_OUT) else "train"
    path = folder / f"{'+'.join(name.replace('/', '-') for name in ablation.hands)}.safetensors"
    if not path.exists():
        code = command(["dataset", "bundle", str(ROOT / "data" / "grasps"), "--split", split, "--hands", *ablation.hands,
                        "--per-pair", str(PER_PAIR), "--output", str(path), "--json"])
        assert code == 0, "the bundle could not be made"
    return load_bundle(path)


def thinned(bundle: Bundle, grasps: int | None) -> Bundle:
    """The bundle with this many grasps of each hand; None for all."""
    if grasps is None:
        return bundle
    fewer = {}
    for hand, known in bundle.grasps.items():
        kept = torch.randperm(len(known.joints), generator=torch.Generator().manual_seed(0))[:grasps]
        fewer[hand] = type(known)(known.T_object_wrist[kept], known.joints[kept], known.object_index[kept])
    return Bundle(bundle.hands, bundle.objects, fewer)


def trained(name: str, ablation: Ablation, folder: Path, steps: int, mixed: bool) -> tuple[DistanceNetwork, float]:
    """The row's network and the seconds that its training took; its run folder lets it resume after an interruption."""
    begin = time.perf_counter()
    if ablation.grasps == 0:
        return load_weights(), 0.0
    whole, place = bundle_of(ablation, folder), folder / name.replace(" ", "_")
    bundle = thinned(whole, ablation.grasps)
    network = dataclasses.replace(NetworkConfig.preset("slim"), **ablation.network)
    initial = load_weights() if ablation.fine_tuned else None
    history = [] if initial is None else history_of(locate_weights())
    first = None
    if ablation.pretrained and initial is None:
        stem = (ablation.pretrained_as or name).replace(" ", "_")
        first = pretrain(whole, network, PretrainConfig(ScheduleConfig(steps=PRETRAINING_STEPS)), folder / f"{stem}_pre")
        if network.latent_form == "motion":
            config = MotionConfig(ScheduleConfig(steps=MOTION_STEPS))
            first = pretrain_motion(first, whole, config, folder / f"{stem}_motion")
    rate = 1e-3 if initial is None else 3e-4
    config = TrainConfig(
        ScheduleConfig(steps=round(ablation.share * steps), learning_rate=rate, mixed=mixed), ablation.losses,
        AugmentationConfig(partial=ablation.partial))
    network = network if initial is None else initial.config
    model = train(bundle, network, config, place, first, name=name, initial=initial)
    about = {"stage": "ablation", "row": name, "steps": config.schedule.steps, "data": bundle.summary()}
    save_weights(model, folder / f"{place.name}.safetensors", about, history)
    return model, time.perf_counter() - begin


def measured(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """Train and evaluate one row."""
    ablation, folder = ROWS[name], options.output
    model, seconds = trained(name, ablation, folder, options.steps, options.mixed)
    predictor = GraspPredictor(str(folder / f"{name.replace(' ', '_')}.safetensors"))
    objects = [load_object(o) for o in resolve_objects(options.objects)]
    config = BenchmarkConfig(options.num, (RAW, REFINED), (protocol("dro"), protocol("strict")), view=ablation.view)
    rows = benchmark([load_hand(h) for h in ablation.evaluated], objects, [DistanceMethod(predictor)], config)
    errors = []
    if set(ablation.evaluated) <= set(HANDS):
        validate = folder / "validate.safetensors"
        if not validate.exists():
            command(["dataset", "bundle", str(ROOT / "data" / "grasps"), "--split", "validate", "--hands", *HANDS, "--output",
                     str(validate), "--json"])
        errors = [dataclasses.asdict(e) for e in distance_errors(model, load_bundle(validate))]
    return {"row": name, "seconds": seconds, "rows": [r.to_dict() for r in rows], "errors": errors}


def cells(result: dict[str, Any]) -> list[list[object]]:
    """Lines of the table: one a hand, and their average."""
    by_hand: dict[str, dict[str, Any]] = {}
    for row in result["rows"]:
        by_hand.setdefault(row["hand"], {})[row["stage"]] = row
    errors = {e["hand"].rpartition("/")[2]: e for e in result["errors"]}
    if errors:
        errors[ALL] = {k: sum(e[k] for e in errors.values()) / len(errors) for k in ("posterior", "prior", "divergence")}
    lines: list[list[object]] = []
    for hand, stages in by_hand.items():
        rates = [f"{100 * rate[0]:.1f}" for s in (RAW, REFINED) for rate in stages[s]["success"].values()]
        error = errors.get(hand.rpartition("/")[2])
        far = ["", "", ""] if error is None else [
            f"{1e3 * error['posterior']:.1f}", f"{1e3 * error['prior']:.1f}", f"{error['divergence']:.2g}"]
        lines.append([result["row"], hand, stages[RAW]["num"], *rates, f"{stages[REFINED]['diversity']:.3f}", *far,
                      f"{result['seconds'] / 60:.0f}"])
    return lines


def draw(results: list[dict[str, Any]], folder: Path, path: Path) -> None:
    """Success against the number of training grasps, over all hands of a row, with 95 % intervals."""
    figure, ax = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
    trainings = [ROWS[r["row"]] for r in results]
    counts = [sum(len(g.joints) for g in thinned(bundle_of(t, folder), t.grasps).grasps.values()) for t in trainings]
    for stage, style in ((RAW, "--"), (REFINED, "-")):
        for name, colour in zip(("dro", "strict"), ("tab:blue", "tab:orange"), strict=True):
            points = []
            for count, result in sorted(zip(counts, results, strict=True), key=lambda pair: pair[0]):
                rows = [r for r in result["rows"] if r["stage"] == stage and r["hand"] != ALL]
                n = sum(r["num"] for r in rows)
                held = sum(rate[0] * r["num"] for r in rows for label, rate in r["success"].items() if label.startswith(name))
                points.append((count, *(100 * share for share in (held / n, *wilson_interval(round(held), n)))))
            x, share, low, high = np.array(points).T
            ax.errorbar(x, share, (share - low, high - share), fmt=f"o{style}", color=colour, capsize=3,
                        label=f"{stage}, {name}")
    ax.set(xscale="log", xlabel="training grasps, over three hands", ylabel="success [%]", ylim=(0, 100))
    ax.grid(alpha=0.3)
    ax.legend(loc="lower left", ncols=2)
    figure.savefig(path, dpi=110)


def main(argv: Sequence[str] | None = None) -> None:
    """Train, evaluate and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True, help="folder for weights and results")
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS), help="rows to train")
    parser.add_argument("--steps", type=int, default=800, help="training steps of 16 samples")
    parser.add_argument("--num", type=int, default=10, help="grasps of each hand on each object")
    parser.add_argument("--objects", nargs="+", default=["assets:validate"], help="objects of the trials, such as builtin:test")
    parser.add_argument("--mixed", action="store_true", help="train with bfloat16 products, where the processor has them")
    parser.add_argument("--picture", type=Path, help="draw success against the number of training grasps")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    options.output.mkdir(parents=True, exist_ok=True)
    results = []
    for name in options.rows:
        where = "" if options.objects == ["assets:validate"] else f" on {' '.join(options.objects)}"
        stored = options.output / f"{f'{name}{where}'.replace(' ', '_')}.json"
        if not stored.exists():
            result = measured(name, options)
            stored.write_text(json.dumps(result))
        results.append(json.loads(stored.read_text()))
    if options.picture is not None:
        draw(results, options.output, options.picture)
    columns = ["row", "hand", "n", "dro raw", "strict raw", "dro refined", "strict refined", "diversity", "posterior [mm]",
               "prior [mm]", "nats", "minutes"]
    emit(f"{options.steps} steps of 16 samples, {options.num} grasps of each hand on each of {' '.join(options.objects)}",
         [line for result in results for line in cells(result)], columns,
         {result["row"]: result for result in results}, options.json)


if __name__ == "__main__":
    main()
