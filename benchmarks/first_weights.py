"""Success of the shipped weights, raw, beside the controls: paper hands on the validate objects.

The distance error is that on the synthesised grasps of the same objects: with z from the true grasp (posterior) and z
from N(0, I) (prior); the open hand is placed near the true grasp, as far off as in training.

    python benchmarks/first_weights.py --bundle bundle.safetensors [--num 20] [--json]

Needs the development assets. The mean grasp comes from the training bundle. All the work on one thread but the trials.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import torch
from report import emit, machine

from dro_grasp import distance_matrix
from dro_grasp.datasets.bundle import Bundle, HandGrasps, ObjectCloud, load_bundle
from dro_grasp.evaluation.controls import mean_grasp, mean_grasps, palm_facing_starts
from dro_grasp.evaluation.metrics import diversity, wilson_interval
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.synthesis import synthesize
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.models.network import DistanceNetwork
from dro_grasp.objects.library import load_object, object_names
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predictor import GraspPredictor
from dro_grasp.simulation.protocols import protocol
from dro_grasp.simulation.trial import settle, simulate
from dro_grasp.training.config import AugmentationConfig
from dro_grasp.training.samples import SampleSource

HANDS = ("assets/barrett_multidex", "assets/allegro_left", "assets/shadowhand")
ROWS = ("network, raw", "mean grasp", "unoptimised start", "synthesised")
ERROR_SAMPLES = 200
"""Placed hands that the distance error is measured on, of each hand."""
PROTOCOLS = {
    "dro": protocol("dro"),
    "dro, friction 3": dataclasses.replace(protocol("dro"), friction=3.0),
    "strict": protocol("strict"),
}


def grasps_of(row: str, hand: Hand, obj: ObjectModel, bundle: Bundle, predictor: GraspPredictor, num: int) -> GraspBatch:
    """The grasps of one row of the table."""
    if row == ROWS[0]:
        return predictor.predict(hand, obj, num=num, seed=0, refine=False)
    if row == ROWS[1]:
        return mean_grasps(hand, obj, mean_grasp(bundle, hand.name), num, seed=0)
    if row == ROWS[2]:
        return palm_facing_starts(hand, obj, num, seed=0)
    return settle(hand, obj, synthesize(hand, obj, 4 * num, seed=0)[slice(0, num)])


@torch.no_grad()
def distance_errors(network: DistanceNetwork, hand: Hand, objects: list[ObjectModel], grasps: list[GraspBatch]) -> list[float]:
    """Mean absolute error of D(R,O) [m] on known grasps, with posterior and with prior z."""
    clouds = {o.name: ObjectCloud(torch.from_numpy(o.cloud), torch.from_numpy(o.cloud_normals)) for o in objects}
    index = torch.cat([torch.full((len(g),), i) for i, g in enumerate(grasps)])
    known = HandGrasps(torch.cat([g.T_object_wrist for g in grasps]), torch.cat([g.joints for g in grasps]), index)
    source = SampleSource(Bundle({hand.name: hand}, clouds, {hand.name: known}), network.config, AugmentationConfig())
    generator = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    samples = source.draw(hand.name, ERROR_SAMPLES, generator)
    true = distance_matrix.build(samples.grasp, samples.obj)
    posterior = network(samples.placed, samples.obj, samples.grasp).distances
    prior = network.predict(samples.placed, samples.obj, network.sample_latent(ERROR_SAMPLES, generator))
    return [float((d - true).abs().mean()) for d in (posterior, prior)]


def main() -> None:
    """Fill the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bundle", type=Path, required=True)
    parser.add_argument("--weights", default=None)
    parser.add_argument("--num", type=int, default=20)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    bundle, predictor = load_bundle(options.bundle), GraspPredictor(options.weights)
    objects = [load_object(n) for n, split in object_names().items() if split == "validate"]
    success: dict[tuple[str, str, str], int] = defaultdict(int)
    spread: dict[tuple[str, str], float] = {}
    errors: dict[str, list[float]] = {}
    began = time.perf_counter()
    for name in HANDS:
        hand = load_hand(name)
        for row in ROWS:
            made = [grasps_of(row, hand, obj, bundle, predictor, options.num) for obj in objects]
            if row == ROWS[3]:
                errors[name] = distance_errors(predictor.network, hand, objects, made)
            everything = GraspBatch.concatenate(made)
            spread[name, row] = diversity(everything.T_object_wrist, everything.joints)["all"]
            for obj, grasps in zip(objects, made, strict=True):
                for rules in PROTOCOLS:
                    success[name, row, rules] += int(simulate(hand, obj, grasps, PROTOCOLS[rules]).success.sum())
    total = options.num * len(objects)
    table: list[list[Any]] = []
    result: dict[str, Any] = {"machine": machine(), "grasps_per_pair": options.num, "objects": len(objects),
                              "seconds": round(time.perf_counter() - began, 1)}
    for row in ROWS:
        for name in (*HANDS, "average"):
            counted = HANDS if name == "average" else (name,)
            cells = []
            for rules in PROTOCOLS:
                k, n = sum(success[h, row, rules] for h in counted), total * len(counted)
                low, high = wilson_interval(k, n)
                cells.append(f"{100 * k / n:.1f} [{100 * low:.0f}-{100 * high:.0f}]")
                result[f"{row}/{name}/{rules}"] = k / n
            mean_spread = sum(spread[h, row] for h in counted) / len(counted)
            table.append([row, name, *cells, f"{mean_spread:.3f}"])
    for kind, i in (("posterior", 0), ("prior", 1)):
        result[f"distance_error_{kind}_mm"] = sum(1e3 * e[i] for e in errors.values()) / len(errors)
    title = f"success [%] with 95 % intervals, {total} grasps a hand, {len(objects)} unseen objects"
    emit(title, table, ["grasps", "hand", *PROTOCOLS, "diversity"], result, options.json)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
