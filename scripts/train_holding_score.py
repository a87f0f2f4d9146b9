"""Train the model that corrects the score of settled grasps by what simulated closing shows, on outcomes of trials.

    python scripts/train_holding_score.py --folder FOLDER [--num N] [--objects N] [--hands HAND ...] [--collect-only]

Candidates of the network and of the optimiser are settled as `generate` does, on training objects. The folder keeps the
grasps of each hand, so a stopped script resumes. Needs the development assets.
"""

from __future__ import annotations

import argparse
import random
from collections import Counter
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch
from torch.nn import functional
from train_ranking import HANDS

from dro_grasp.compare.metrics import roc_area
from dro_grasp.hands.library import load_hand
from dro_grasp.network.checkpoints import load_weights, save_weights
from dro_grasp.network.network import DistanceNetwork
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.score.score import SHIPPED_HOLDING, HoldingScore, holding_features
from dro_grasp.predict.settling import settle_grasps
from dro_grasp.predict.sources.network import propose
from dro_grasp.predict.sources.optimiser import OptimiserSource
from dro_grasp.predict.stages import refine, scored
from dro_grasp.simulation.grasp_state import GraspState
from dro_grasp.simulation.trial import simulate

TRIALS = ("strict", "dexgraspbench", "robust")
"""Protocols whose outcome the model predicts; the score is the mean of their log-odds."""
FOLDS = 5
"""Groups of hands, each left out of one fit, whose grasps judge it."""
WIDTH, STEPS, RATE, DECAY = 8, 600, 1e-2, 0.3
"""Width of the hidden layer; steps, peak learning rate and weight decay of the fit."""
NOISE = 0.05
"""Standard deviation of the noise on inputs, as a share of theirs."""


def collect(network: DistanceNetwork, name: str, objects: int, num: int, seed: int) -> Iterator[dict[str, Any]]:
    """Settled grasps of one hand on some training objects: their score, how they hold, and outcomes of trials."""
    hand, rng = load_hand(name), random.Random(f"{name} {seed}")
    for label in rng.sample(resolve_objects(["assets:train"]), objects):
        obj = load_object(label)
        problem = GraspProblem(hand, obj)
        generator = torch.Generator().manual_seed(rng.randrange(10**6))
        found = {"network": propose(problem, network, num, generator).grasps,
                 "optimiser": OptimiserSource().propose(problem, num, rng.randrange(10**6)).grasps}
        for maker, grasps in found.items():
            grasps = scored(problem, refine(problem, grasps))
            better = grasps[grasps.score.topk(max(1, len(grasps) // 2)).indices]
            found = settle_grasps(problem, better)
            grasps = found.grasps[found.stable]
            if not len(grasps):
                continue
            outcomes = torch.stack([simulate(hand, obj, grasps, rules).success for rules in TRIALS], 1)
            yield {"hand": hand.name, "object": label, "maker": maker, "score": scored(problem, grasps).score,
                   "outcomes": outcomes.float(), **{f.name: getattr(found.state, f.name) for f in fields(GraspState)}}


def fit(parts: list[dict[str, Any]], seed: int) -> HoldingScore:
    """A model of the outcomes of these grasps."""
    torch.manual_seed(seed)  # of the initial weights
    generator = torch.Generator().manual_seed(seed)
    features, outcomes = (torch.cat([part[key] for part in parts]) for key in ("features", "outcomes"))
    model = HoldingScore(len(TRIALS), WIDTH)
    model.mean, model.deviation = features.mean(0), features.std(0) + 1e-3
    optimiser = torch.optim.AdamW(model.layers.parameters(), RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=STEPS)
    for _ in range(STEPS):
        noise = NOISE * model.deviation * torch.randn(features.shape, generator=generator)
        loss = functional.binary_cross_entropy_with_logits(model(features + noise), outcomes)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return model.eval().requires_grad_(False)


def judged(parts: list[dict[str, Any]], seed: int) -> dict[str, Any]:
    """What fits that left some hands out say of the grasps of these hands: loss, and ROC areas with and without the model."""
    hands = sorted({part["hand"] for part in parts})
    random.Random(seed).shuffle(hands)
    found, before, outcomes = [], [], []
    for fold in range(FOLDS):
        out = set(hands[fold::FOLDS])
        model = fit([part for part in parts if part["hand"] not in out], seed)
        for part in parts:
            if part["hand"] in out:
                found.append(model(part["features"]))
                before.append(part["score"])
                outcomes.append(part["outcomes"])
    odds, scores, held = torch.cat(found), torch.cat(before), torch.cat(outcomes)
    return {
        "loss": float(functional.binary_cross_entropy_with_logits(odds, held)),
        "areas": {rules: roc_area(odds.mean(1), held[:, k] > 0.5) for k, rules in enumerate(TRIALS)},
        "areas_before": {rules: roc_area(scores, held[:, k] > 0.5) for k, rules in enumerate(TRIALS)},
    }


def main() -> None:
    """Collect, fit, save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="folder for the grasps")
    parser.add_argument("--hands", nargs="+", default=list(HANDS), help="hands to collect grasps of")
    parser.add_argument("--objects", type=int, default=3, help="training objects of each hand")
    parser.add_argument("--num", type=int, default=24, help="candidates of each, from each origin")
    parser.add_argument("--seed", type=int, default=0, help="seed of everything")
    parser.add_argument("--collect-only", action="store_true", help="do not fit")
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.folder.mkdir(parents=True, exist_ok=True)
    network = load_weights(None)
    for name in options.hands:
        stem = Path(name).stem if Path(name).suffix else name.replace("/", "-")
        path = options.folder / f"{stem}-{options.seed}.pt"
        if not path.exists():
            torch.save(list(collect(network, name, options.objects, options.num, options.seed)), path)
            print(name, flush=True)
    if options.collect_only:
        return
    parts = [part for path in sorted(options.folder.glob("*.pt")) for part in torch.load(path, weights_only=True)]
    for part in parts:
        part["features"] = holding_features(part["score"], GraspState(**{f.name: part[f.name] for f in fields(GraspState)}))
    found, grasps = judged(parts, options.seed), sum(len(part["score"]) for part in parts)
    print(f"{grasps} grasps; hands left out of a fit: {found}")
    about = {
        "stage": "ranking of settled grasps", "script": Path(__file__).name, "trials": TRIALS, "seed": options.seed, **found,
        "data": {"hands": dict(Counter(part["hand"] for part in parts for _ in part["score"])), "grasps": grasps},
    }
    save_weights(fit(parts, options.seed), SHIPPED_HOLDING, about)


if __name__ == "__main__":
    main()
