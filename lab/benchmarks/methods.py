"""Grasps as `generate` returns them, with candidates from the network, from the optimiser, or from both, at any cost in time.

    python -m lab.benchmarks.methods [--hands HAND ...] [--objects NAME ...] [--num N] [--weights NAME] [--json]

The best by score of each source are evaluated on the mesh; fingers are counted under `strict`, after closing. The processor
time counts everything but the trial. The row `network, first z` decodes the first z that is drawn, without a choice by
geometry. Needs the development assets by default.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
import torch

from dro_grasp.compare.stages import pair_seed
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.predict.config import GraspRequest, PredictorConfig
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.choice import ChoiceConfig
from dro_grasp.predict.sources.network import ProposalConfig
from dro_grasp.simulation.trial import simulate
from dro_grasp.training.data.bundle.training_file import HELD_OUT_HANDS
from lab.benchmarks.report import emit, rate

PROTOCOLS = ("dro", "strict")
"""Trials of every grasp."""
FIRST_Z = "network, first z"
"""Row without a choice of z."""
METHODS = (FIRST_Z, "network", "optimise", "auto")
"""Rows of each hand."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hands", nargs="+", default=sorted(HELD_OUT_HANDS), help="hands; all left out of training by default")
    parser.add_argument("--objects", nargs="+", default=["builtin:test"], help="objects")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="rows")
    parser.add_argument("--num", type=int, default=16, help="grasps of each hand on each object")
    parser.add_argument("--weights", help="weights of the network; the default ones without")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    torch.set_num_threads(1)
    predictor = GraspPredictor(options.weights)
    first = GraspPredictor(options.weights, config=PredictorConfig(network=ProposalConfig(choice=ChoiceConfig.first())))
    found: dict[tuple[str, str], list[np.ndarray]] = {}
    for hand in map(load_hand, options.hands):
        for obj in map(load_object, resolve_objects(options.objects)):
            problem = GraspProblem(hand, obj)
            _ = problem.field, obj.parts
            request = GraspRequest(options.num, pair_seed(0, hand, obj))
            for method in options.methods:
                begin = time.process_time()
                source, chosen = (first, "network") if method == FIRST_Z else (predictor, method)
                made = source.run(problem, replace(request, source=chosen))
                seconds = (time.process_time() - begin) / options.num
                trials = [simulate(hand, obj, made.grasps, name) for name in PROTOCOLS]
                touching = trials[-1].fingers_in_contact / len(hand.fingers)
                optimised = torch.tensor([float(origin == "optimiser") for origin in made.origin])
                rows = torch.stack([*(trial.success.float() for trial in trials), touching, touching.eq(1).float(), optimised,
                                    torch.full_like(optimised, seconds)], 1).numpy()
                for row in (hand.name, "all"):
                    found.setdefault((row, method), []).append(rows)
    table: list[list[object]] = []
    for (hand_name, method), parts in found.items():
        values = np.concatenate(parts)
        touching, all_touch, optimised, seconds = values[:, len(PROTOCOLS) :].mean(0)
        asked = options.num * len(parts)
        table.append([hand_name, method, asked, *(rate(column, asked) for column in values[:, : len(PROTOCOLS)].T),
                      f"{100 * touching:.0f} ({100 * all_touch:.0f})", f"{100 * optimised:.0f}", f"{seconds:.2f}"])
    columns = ["hand", "method", "n", *(f"{name} [%]" for name in PROTOCOLS), "fingers in contact (all) [%]",
               "from the optimiser [%]", "CPU seconds a grasp"]
    emit(f"{options.num} grasps of each hand on each of {' '.join(options.objects)}", table, columns,
         {f"{row[0]} / {row[1]}": dict(zip(columns[2:], row[2:], strict=True)) for row in table}, options.json)


if __name__ == "__main__":
    main()
