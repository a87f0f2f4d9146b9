"""Where success is lost on objects seen in part: in prediction, or in refinement and ranking on a completed surface.

    python -m lab.benchmarks.seen_in_part [--views cloud half depth] [--num N] [--json]

Grasps of the paper's hands on the validate objects are predicted from the view or from the mesh, refined and ranked on the
view's cloud or on the mesh, and evaluated on the mesh, always at the temperature of bare clouds. Needs the development assets.
"""

from __future__ import annotations

import argparse
from typing import get_args

import torch

from dro_grasp.compare.stages import KEPT, pair_seed
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.objects.perception.partial_views import View, partial_view
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimize.grasp_energy import GraspEnergy
from dro_grasp.predict.config import PredictorConfig
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.network import ProposalConfig
from dro_grasp.predict.stages import refine, scored
from dro_grasp.simulation.trial import simulate
from lab.benchmarks.report import emit
from lab.benchmarks.synthesis import HANDS

PROTOCOLS = ("dro", "strict")
"""Trials of every grasp."""
DEEP = 0.003
"""Penetration of the opened hand beyond which a trial begins inside the object [m]."""


def outcomes(
    hand: Hand, obj: ObjectModel, shown: ObjectModel, judged: ObjectModel, num: int
) -> dict[str, torch.Tensor]:
    """Outcomes of grasps predicted from what is shown, refined and ranked on what is judged: all, and the best quarter."""
    predictor = GraspPredictor(config=PredictorConfig(network=ProposalConfig(temperature=ProposalConfig.cloud_temperature)))
    raw = predictor.predict(hand, shown, num, pair_seed(0, hand, obj), candidates=1, refine=False, source="network")
    problem = GraspProblem(hand, judged)
    grasps = scored(problem, refine(problem, raw))
    best = grasps.score.topk(round(KEPT * num)).indices
    found = {}
    for name in PROTOCOLS:
        success = simulate(hand, obj, grasps, name).success.float()
        found |= {name: success, f"{name}, ranked": success[best]}
    points = hand.points(grasps.pregrasp_joints, grasps.T_object_wrist)
    inside = -GraspEnergy.of_object(hand, obj).field.distances(points)[0].amin(1) > DEEP
    return found | {"begins inside": inside.float()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", nargs="+", choices=get_args(View), default=["cloud", "half", "depth"])
    parser.add_argument("--num", type=int, default=24, help="grasps of each pair, of which the best quarter is kept")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    torch.set_num_threads(1)
    found: dict[tuple[str, str, str], list[dict[str, torch.Tensor]]] = {}
    for hand in map(load_hand, HANDS):
        for obj in map(load_object, resolve_objects(["assets:validate"])):
            for view in options.views:
                part = partial_view(obj, view, pair_seed(0, hand, obj))
                for shown, judged in (("view", "view"), ("view", "mesh"), ("mesh", "view")):
                    models = {"view": part, "mesh": obj}
                    outcome = outcomes(hand, obj, models[shown], models[judged], options.num)
                    found.setdefault((view, shown, judged), []).append(outcome)
    rows = []
    for key, parts in found.items():
        rates = {name: 100 * float(torch.cat([p[name] for p in parts]).mean()) for name in parts[0]}
        rows.append([*key, sum(len(p["dro"]) for p in parts), *rates.values()])
    columns = ["view", "predicted from", "refined and ranked on", "n", *next(iter(found.values()))[0]]
    emit(f"objects seen in part, {options.num} grasps of each hand on each object; per cent", rows, columns,
         {" / ".join(row[:3]): dict(zip(columns[3:], row[3:], strict=True)) for row in rows}, options.json)


if __name__ == "__main__":
    main()
