"""Diversity of predicted grasps beside that of the stored grasps of the same objects, of wrist and joints apart.

    python -m lab.benchmarks.diversity [--weights NAME|PATH] [--num N] [--temperature T] [--json]

The paper's measure, over successes and failures. Needs the development assets.
"""

from __future__ import annotations

import argparse

import torch

from dro_grasp.compare.metrics import diversity
from dro_grasp.compare.stages import pair_seed
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.predict.config import PredictorConfig
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.sources.network import ProposalConfig
from dro_grasp.training.data.collections.merging import file_name
from lab.benchmarks.report import ROOT, emit
from lab.benchmarks.synthesis import HANDS


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", default=None, help="name of shipped weights, or a weights file")
    parser.add_argument("--num", type=int, default=30, help="predicted grasps of each hand on each object")
    parser.add_argument("--temperature", type=float, default=1.0)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    torch.set_num_threads(1)
    predictor = GraspPredictor(options.weights, config=PredictorConfig(network=ProposalConfig(temperature=options.temperature)))
    objects = [load_object(name) for name in resolve_objects(["assets:validate"])]
    rows: list[list[object]] = []
    for name in HANDS:
        hand = load_hand(name)
        stored = GraspBatch.load(ROOT / "data" / "grasps" / file_name(name))
        stored = stored[torch.tensor([split == "validate" for split in stored.split])]
        made = GraspBatch.concatenate([
            predictor.predict(
                hand, obj, options.num, pair_seed(0, hand, obj), candidates=1, refine=False, source="network")
            for obj in objects])
        for kind, grasps in (("stored", stored), ("predicted", made)):
            spread = diversity(grasps.T_object_wrist, grasps.joints)
            rows.append([hand.name, kind, len(grasps), spread["wrist"], spread["joints"], spread["all"]])
    columns = ["hand", "grasps", "n", "wrist", "joints", "diversity"]
    emit(f"diversity of '{predictor.weights_name}' at temperature {options.temperature:g}", rows, columns,
         {f"{row[0]}, {row[1]}": dict(zip(columns[2:], row[2:], strict=True)) for row in rows}, options.json)


if __name__ == "__main__":
    main()
