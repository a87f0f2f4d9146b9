"""Whether the confidence that a grasp is returned with is how often such grasps hold: predicted against observed, in ten bins.

All that `generate` returns with a least confidence of 0 is tried under `carry`, which the confidence is about. It also tells
what each least confidence costs of the grasps that hold, and drops of those that fail. Nothing is chosen here.

    python -m lab.studies.confidence [--hands HAND ...] [--made 10] [--objects OBJECT ...] [--view whole] [--num 8] [--json]
"""

from __future__ import annotations

import tempfile
from itertools import product
from pathlib import Path
from typing import get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.cli.output import progress_bar
from dro_grasp.compare.metrics import roc_area
from dro_grasp.compare.stages import pair_seed
from dro_grasp.errors import NoGraspError
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.objects.perception.partial_views import View, partial_view
from dro_grasp.predict.config import GraspRequest
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.simulation.trial import simulate
from dro_grasp.training.made_hands.making import hand_name, make_hand
from lab.benchmarks.report import emit, options_of
from lab.calibration import price_of_least, reliability

FIRST_MADE = 9000  # Seed of the first made-up hand: no weights have seen it
LEVELS = (0.05, 0.1, 0.15, 0.2, 0.3, 0.5)  # Least confidences whose price is told
COLUMNS = ["confidence", "n", "predicted [%]", "held [%]", "95 % interval"]


def hands_of(names: list[str], made: int, folder: Path) -> list[str]:
    """Hands by name, and files of made-up ones."""
    files = []
    for seed in range(FIRST_MADE, FIRST_MADE + made):
        files.append(folder / f"{hand_name(seed)}.urdf")
        files[-1].write_text(make_hand(seed).urdf)
    return [*names, *map(str, files)]


def returned(
    predictor: GraspPredictor, hand_name: str, object_name: str, view: View, num: int, protocol: str
) -> tuple[Float[Tensor, " n"], Bool[Tensor, " n"]]:
    """Confidences of all grasps that are returned for a pair, and whether they hold the whole object."""
    hand, obj = load_hand(hand_name), load_object(object_name)
    seed = pair_seed(0, hand, obj)
    try:
        made = predictor.run(GraspProblem(hand, partial_view(obj, view, seed)), GraspRequest(num, seed, least_confidence=0.0))
    except NoGraspError:
        return torch.zeros(0), torch.zeros(0, dtype=torch.bool)
    return made.grasps.confidence, simulate(hand, obj, made.grasps, protocol, another=True).success


def main() -> None:
    """Measure."""
    parser = options_of(__doc__)
    parser.add_argument("--hands", nargs="*", default=[], help="names or files of hands")
    parser.add_argument("--made", type=int, default=0, help="made-up hands beside them")
    parser.add_argument("--objects", nargs="+", default=["builtin:hard_train"], help="names, files or groups of objects")
    parser.add_argument("--view", choices=get_args(View), default="whole", help="what is seen of the objects")
    parser.add_argument("--num", type=int, default=8, help="grasps of each pair")
    parser.add_argument("--protocol", default="carry", help="trial")
    options = parser.parse_args()
    predictor, objects = GraspPredictor(), resolve_objects(options.objects)
    pairs = []
    with tempfile.TemporaryDirectory() as folder, progress_bar("pairs", options.json) as progress:
        hands = hands_of(options.hands, options.made, Path(folder))
        for hand, obj in product(hands, objects):
            pairs.append(returned(predictor, hand, obj, options.view, options.num, options.protocol))
            if progress is not None:
                progress(len(pairs), len(hands) * len(objects))
    confidence, held = (torch.cat(column) for column in zip(*pairs, strict=True))
    bins = reliability(confidence, held)
    facts = {
        "hands": [Path(hand).stem for hand in hands], "objects": objects, "view": options.view, "protocol": options.protocol,
        "asked": options.num * len(pairs), "returned": len(held), "held": int(held.sum()),
        "area": roc_area(confidence.float(), held), "bins": bins,
        "least": [price_of_least(confidence, held, least) for least in LEVELS]}
    rows = [[f"{b['from']:.1f} to {b['to']:.1f}", b["n"], f"{100 * b['predicted']:.0f}", f"{100 * b['observed']:.0f}",
             f"{100 * b['low']:.0f} to {100 * b['high']:.0f}"] for b in bins]
    title = f"{int(held.sum())} of {len(held)} grasps hold under {options.protocol}; {facts['asked']} were asked for"
    emit(title, rows, COLUMNS, facts, options.json)


if __name__ == "__main__":
    main()
