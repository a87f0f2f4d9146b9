"""Success of the network alone when it sees all points of an object, half of them, or half of them completed.

    python -m lab.studies.bare_halves [--weights NAME|PATH ...] [--num N] [--json]

Grasps are predicted from the points, neither refined nor ranked, and evaluated on the mesh. `bare half` is what training
with `--partial` shows: 50 % of the points and nothing else. Needs the development assets.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch

from dro_grasp.compare.stages import pair_seed
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.objects.loading import cloud_object
from dro_grasp.objects.perception.partial_views import partial_view, visible_side
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.simulation.trial import simulate
from lab.benchmarks.report import emit, rate
from lab.benchmarks.synthesis import HANDS

PROTOCOLS = ("dro", "strict")
"""Trials of every grasp."""


def shown(obj: ObjectModel, seed: int) -> dict[str, ObjectModel]:
    """The three views of an object; the two halves are the same half."""
    points, normals, _ = visible_side(obj, "half", seed)
    bare = cloud_object(f"{obj.name}, bare half", np.concatenate([points, normals], 1), origin=obj.name)
    whole, completed = (partial_view(obj, view, seed) for view in ("cloud", "half"))
    return {"all points": whole, "bare half": bare, "completed half": completed}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", nargs="+", default=[None], help="names of shipped weights, or weights files")
    parser.add_argument("--num", type=int, default=24, help="grasps of each hand on each object")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    torch.set_num_threads(1)
    objects = [load_object(name) for name in resolve_objects(["assets:validate"])]
    rows = []
    for weights in options.weights:
        predictor = GraspPredictor(weights)
        passed: dict[tuple[str, str], dict[str, list[bool]]] = {}
        for hand in map(load_hand, HANDS):
            for obj in objects:
                seed = pair_seed(0, hand, obj)
                for view, model in shown(obj, seed).items():
                    grasps = predictor.predict(hand, model, options.num, seed, refine=False, candidates=1, source="network")
                    for name in PROTOCOLS:
                        held = simulate(hand, obj, grasps, name).success.tolist()
                        for row in (hand.name, "average"):
                            passed.setdefault((view, row), {}).setdefault(name, []).extend(held)
        for (view, hand_name), outcomes in sorted(passed.items(), key=lambda item: item[0][1] == "average"):
            rows.append([predictor.weights_name, view, hand_name, len(outcomes[PROTOCOLS[0]]), *map(rate, outcomes.values())])
    columns = ["weights", "points", "hand", "n", *(f"{name} [%]" for name in PROTOCOLS)]
    emit(f"network alone on points of the validate objects, {options.num} grasps of each hand on each", rows, columns,
         {" / ".join(row[:3]): dict(zip(columns[3:], row[3:], strict=True)) for row in rows}, options.json)


if __name__ == "__main__":
    main()
