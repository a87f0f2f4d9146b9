"""What the score of a grasp is worth where part of the object is a guess: `guess_offset`, `guess_worth`, `clearance_worth`.

Training objects are seen in a depth image or in half; what `generate` then returns, however little it is trusted, is tried on
the whole object under `carry`. Three numbers are fitted: an offset, the worth of the score, and of clearance that the opened
hand lacks. What is returned depends a little on what the three are now. Objects are left out in fifths, and bins tell how well
the others predict them.

    python -m lab.studies.seen_score --folder FOLDER [--hands HAND ...] [--objects OBJECT ...] [--pairs 120] [--json]

The folder keeps each pair, so a stopped study resumes.
"""

from __future__ import annotations

import random
from itertools import product
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from dro_grasp.compare.metrics import roc_area
from dro_grasp.compare.stages import pair_seed
from dro_grasp.errors import NoGraspError
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.objects.perception.partial_views import View, partial_view
from dro_grasp.optimize.fingers import missing_clearance
from dro_grasp.optimize.grasp_energy import EnergyConfig
from dro_grasp.predict.config import GraspRequest
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.settling import SettleConfig
from dro_grasp.simulation.trial import simulate
from lab.benchmarks.report import emit, options_of
from lab.calibration import reliability

HANDS = ["allegro", "barrett", "gripper3", "leaphand", "shadowhand"]
VIEWS: tuple[View, ...] = ("depth", "half")
FIFTHS = 5  # Parts of the objects, each left out once
RIDGE = 0.5  # Weight of squared standardised weights in the fit


def scored(predictor: GraspPredictor, hand_name: str, object_name: str, view: View, num: int) -> Float[Tensor, "n 3"]:
    """Score that no guess has lowered, missing clearance [m] and outcome of what is returned for a pair."""
    hand, obj = load_hand(hand_name), load_object(object_name)
    seed = pair_seed(0, hand, obj)
    problem = GraspProblem(hand, partial_view(obj, view, seed))
    if problem.obj.seen is None:
        return torch.zeros(0, 3)
    try:
        grasps = predictor.run(problem, GraspRequest(num, seed, least_confidence=0.0)).grasps
    except NoGraspError:
        return torch.zeros(0, 3)
    lacking = missing_clearance(problem.energy(EnergyConfig()), grasps, problem.obj.seen)
    config = SettleConfig()
    whole = (grasps.score - config.guess_offset + config.clearance_worth * lacking) / config.guess_worth
    return torch.stack([whole, lacking, simulate(hand, obj, grasps, another=True).success.float()], 1)


def fit(features: Float[Tensor, "n 2"], held: Bool[Tensor, " n"]) -> Float[Tensor, "3"]:
    """Offset and weights of a logistic regression."""
    deviation, target = features.std(0), held.double()
    weights = torch.zeros(3, dtype=torch.double, requires_grad=True)
    optimiser = torch.optim.LBFGS([weights], max_iter=200, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimiser.zero_grad()
        odds = weights[0] + (features / deviation).double() @ weights[1:]
        value = functional.binary_cross_entropy_with_logits(odds, target, reduction="sum") + RIDGE * (weights[1:] ** 2).sum()
        value.backward()
        return value

    optimiser.step(loss)
    return torch.cat([weights[:1], weights[1:] / deviation]).detach().float()


def odds(weights: Float[Tensor, "3"], features: Float[Tensor, "n 2"]) -> Float[Tensor, " n"]:
    """Log-odds that a grasp holds."""
    return weights[0] + features @ weights[1:]


def main() -> None:
    """Collect, fit, print."""
    parser = options_of(__doc__)
    parser.add_argument("--folder", type=Path, required=True, help="where pairs are kept")
    parser.add_argument("--hands", nargs="+", default=HANDS)
    parser.add_argument("--objects", nargs="+", default=["builtin:train"], help="training objects, never others")
    parser.add_argument("--num", type=int, default=16, help="grasps of each pair")
    parser.add_argument("--pairs", type=int, default=120, help="pairs of hand, object and view, drawn at random")
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.folder.mkdir(parents=True, exist_ok=True)
    predictor = GraspPredictor()
    pairs: list[tuple[str, str, View]] = list(product(options.hands, resolve_objects(options.objects), VIEWS))
    random.Random(0).shuffle(pairs)
    parts: list[Tensor] = []
    places: list[int] = []
    names = sorted({obj for _, obj, _ in pairs})
    for hand, obj, view in pairs[:options.pairs]:
        kept = options.folder / f"{hand}-{obj}-{view}.pt".replace("/", "%")
        if not kept.exists():
            torch.save(scored(predictor, hand, obj, view, options.num), kept)
        parts.append(torch.load(kept))
        places += [names.index(obj)] * len(parts[-1])
    data, place = torch.cat(parts), torch.tensor(places)
    features, held = data[:, :2], data[:, 2] > 0
    left_out = torch.zeros(len(data))
    for part in range(FIFTHS):
        out = place % FIFTHS == part
        left_out[out] = odds(fit(features[~out], held[~out]), features[out])
    offset, worth, clearance = fit(features, held).tolist()
    bins = reliability(left_out.sigmoid(), held)
    facts = {
        "pairs": len(parts), "grasps": len(data), "held": int(held.sum()), "guess_offset": offset, "guess_worth": worth,
        "clearance_worth": -clearance, "area": roc_area(left_out, held), "area, score alone": roc_area(features[:, 0], held),
        "bins": bins}
    rows = [[f"{b['from']:.1f} to {b['to']:.1f}", b["n"], f"{100 * b['predicted']:.0f}", f"{100 * b['observed']:.0f}"]
            for b in bins]
    title = (f"offset {offset:.2f}, worth {worth:.2f}, clearance {-clearance:.0f} per metre; {facts['held']} of {len(data)} "
             f"hold; area {facts['area']:.2f}, {facts['area, score alone']:.2f} of the score alone")
    emit(title, rows, ["left-out confidence", "n", "predicted [%]", "held [%]"], facts, options.json)
    if not options.json:
        now = SettleConfig()
        print(f"settling takes offset {now.guess_offset}, worth {now.guess_worth}, clearance {now.clearance_worth:g}; new "
              "scores or a new completion may need others, in `SettleConfig`")


if __name__ == "__main__":
    main()
