"""Train the score of settled grasps on outcomes of trials, and calibrate it.

    python -m lab.recipe.holding --folder FOLDER [--weights FILE] [--ranking FILE] [--output FILE] [--num N] [--rounds N]

Candidates of the network and of the optimiser are settled as `generate` does, on training objects, on hard ones for training,
and on stretched and heavy ones, by training hands, by the same ones smaller and larger, and by made-up hands. The folder keeps
the grasps of each pair of hand and object, so a stopped script resumes. Assets are needed where hands or objects are of them.
"""

from __future__ import annotations

import argparse
import json
import math
import random
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch.nn import functional

from dro_grasp.compare.metrics import roc_area
from dro_grasp.files import replacing
from dro_grasp.hands.library import load_hand
from dro_grasp.hands.variants import vary_hand
from dro_grasp.network.checkpoints import load_weights, locate_weights, save_weights
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.score.holding import SHIPPED_HOLDING, Evidence, HoldingScore, holding_features
from dro_grasp.predict.score.score import SHIPPED, ScoreConfig
from dro_grasp.predict.settling import settle_all
from dro_grasp.predict.sources.network import propose
from dro_grasp.predict.sources.optimiser import OptimiserSource
from dro_grasp.predict.stages import complete, refine, scored
from dro_grasp.provenance import made_by
from dro_grasp.simulation.grasp_state import GraspState
from dro_grasp.simulation.trial import simulate
from dro_grasp.training.made_hands.making import make_hand
from lab.calibration import price_of_least, reliability
from lab.recipe.parts import checksum, fill, fingerprint
from lab.recipe.ranking import HANDS

TRIALS = ("carry", "robust")
"""Protocols whose outcome the model predicts."""
COSTLY = 0.15
"""Share of the pairs of hand and object whose grasps get the second kind of trial, too, which takes eight times as long."""
FIRST_MADE = 20_000
"""Seed of the first made-up hand; the ranking network has seen others."""
VARIED = {"allegro": 0.5, "barrett": 0.75, "gripper3": 1.4, "leaphand": 2.0, "shadowhand": 0.6}
"""Sizes of varied training hands."""
GROUPS = ("assets:train", "builtin:hard_train")
"""Groups of objects, each as often as any other."""
STRETCH = (0.6, 1.8)
"""Bounds of the factor of an object's size, drawn for a third of the pairs."""
HEAVY = (0.3, 8.0)
"""Bounds of the factor of its density, likewise."""
UNSETTLED = 6
"""Grasps of each pair that are tried as refined, without settling."""
WEIGHT = (0.75, 0.25)
"""Weight of each kind of trial in the rank of a grasp."""
RETURNED = 6
"""Grasps of each pair that count as returned: the best of four times as many, as by default."""
FOLDS = 5
"""Groups of hands, each left out of one fit."""
WIDTH, STEPS, RATE, DECAY = 8, 600, 1e-2, 0.3
"""Width of the hidden layer; steps, peak learning rate and weight decay of the fit."""
NOISE = 0.05
"""Standard deviation of the noise on inputs, as a share of theirs."""
PRIOR = 2.0
"""How strongly the calibration is drawn to none."""
LEVELS = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4)
"""Least confidences whose price is told."""
SEED = 0
"""Of fits and folds."""


def hands(folder: Path, trained: Sequence[str], made: int) -> list[str]:
    """Training hands, varied ones of those that are built in, and made-up ones, in the order in which they are used."""
    folder.mkdir(parents=True, exist_ok=True)
    varied = {f"{name}_{factor:g}": partial(vary_hand, name, factor=factor)
              for name, factor in VARIED.items() if name in trained}
    drawn = {f"hand_{seed:05d}": partial(_made, seed) for seed in range(FIRST_MADE, FIRST_MADE + made)}
    found = list(trained)
    for stem, make in {**varied, **drawn}.items():
        path = folder / f"{stem}.urdf"
        if not path.exists():
            with replacing(path) as temporary:
                temporary.write_text(make())
        found.append(str(path))
    return found


def _made(seed: int) -> str:
    return make_hand(seed).urdf


def some_object(rng: random.Random, groups: Sequence[str]) -> tuple[str, ObjectModel]:
    """A training object of these groups; some are stretched, some heavy or light."""
    label = rng.choice(resolve_objects([rng.choice(groups)]))
    scale = rng.uniform(*STRETCH) if rng.random() < 1 / 3 else 1.0
    obj = load_object(label, scale=scale)
    low, high = HEAVY
    heavier = low * (high / low) ** rng.random() if rng.random() < 1 / 3 else 1.0
    return f"{label} x{scale:.2f} m{heavier:.2f}", replace(obj, density=obj.density * heavier)


@dataclass(frozen=True)
class Plan:
    """What is collected of each hand and turn."""

    weights: str | None  # that predict the grasps
    ranking: Path | None  # weights that rank them
    groups: tuple[str, ...]  # of objects
    num: int  # predicted grasps of each, and half as many of the optimiser


def collect(plan: Plan, given: tuple[str, str]) -> tuple[list[dict[str, Any]], str]:
    """Grasps of a hand, of this name and with this seed, on an object, and what to print of them."""
    parts = list(tried(plan, given[0], random.Random(given[1])))
    held = [round(share, 2) for share in torch.cat([part["outcomes"] for part in parts]).nanmean(0).tolist()]
    return parts, f"{parts[0]['object']}, {sum(len(part['score']) for part in parts)} grasps, held {held}"


def tried(plan: Plan, name: str, rng: random.Random) -> Iterator[dict[str, Any]]:
    """Grasps of a hand on an object: their score, what closing showed, and outcomes of trials; NaN where not tried."""
    hand, (label, obj), num, network = load_hand(name), some_object(rng, plan.groups), plan.num, load_weights(plan.weights)
    config = ScoreConfig(weights=plan.ranking)
    problem, costly = GraspProblem(hand, obj), rng.random() < COSTLY
    generator = torch.Generator().manual_seed(rng.randrange(10**6))
    about = {"hand": hand.name, "object": label}
    found = {"network": propose(problem, network, num, generator).grasps,
             "optimiser": OptimiserSource().propose(problem, num // 2, rng.randrange(10**6)).grasps}
    for maker, grasps in found.items():
        if not len(grasps):
            continue
        grasps = scored(problem, refine(problem, grasps), config)
        few = grasps[torch.randperm(len(grasps), generator=generator)[:UNSETTLED // len(found)]]
        yield {**about, "maker": f"{maker}, unsettled", "score": few.score,
               "outcomes": outcomes(problem, few, False), **columns(Evidence.none(len(few), obj.mass))}
        better = grasps[grasps.score.topk(max(1, len(grasps) // 2)).indices]
        settled = settle_all([problem], [better])[0]
        yield {**about, "maker": maker, "score": scored(problem, settled.grasps, config).score,
               "outcomes": outcomes(problem, settled.grasps, costly), **columns(settled.known)}


def outcomes(problem: GraspProblem, grasps: Any, costly: bool) -> torch.Tensor:
    """Success in each kind of trial; NaN in those that are too costly."""
    grasps = complete(problem, grasps)
    missing = torch.full((len(grasps),), torch.nan)
    return torch.stack([simulate(problem.hand, problem.solid, grasps, rules).success.float() if costly or not k else missing
                        for k, rules in enumerate(TRIALS)], 1)


def columns(known: Evidence) -> dict[str, Any]:
    """What is known of grasps, as a file keeps it."""
    own = {f.name: getattr(known, f.name) for f in fields(known) if f.name != "state"}
    return own | {"state": {f.name: getattr(known.state, f.name) for f in fields(known.state)}}


@dataclass(frozen=True)
class Rows:
    """Grasps of many pairs, in rows."""

    features: torch.Tensor
    score: torch.Tensor  # of the ranking network
    outcomes: torch.Tensor  # NaN where not tried
    hand: list[str]
    pair: torch.Tensor  # number of the pair of hand and object
    settled: torch.Tensor  # whether it was settled, as what is returned is; the others are tried as refined

    @staticmethod
    def read(folder: Path) -> Rows:
        """All grasps of a folder."""
        features, score, outcomes, hand, pair, settled = [], [], [], [], [], []
        for number, path in enumerate(sorted(folder.glob("*.pt"))):
            for part in torch.load(path, weights_only=True):
                state = GraspState(**{"pierced": torch.zeros(len(part["state"]["shift"]))} | part["state"])
                known = Evidence(**{f.name: part[f.name] for f in fields(Evidence) if f.name != "state"}, state=state)
                n = len(part["score"])
                features.append(holding_features(part["score"], known))
                score.append(part["score"])
                outcomes.append(part["outcomes"])
                hand += [part["hand"]] * n
                pair += [number] * n
                settled += [not part["maker"].endswith("unsettled")] * n
        return Rows(torch.cat(features), torch.cat(score), torch.cat(outcomes), hand, torch.tensor(pair), torch.tensor(settled))

    def of(self, hands: set[str], inside: bool = True) -> torch.Tensor:
        """Which rows are of these hands, or of others."""
        return torch.tensor([(hand in hands) == inside for hand in self.hand])

    def returned(self, rank: torch.Tensor) -> torch.Tensor:
        """Which rows a request would return: the best of each pair by rank."""
        kept = torch.zeros(len(self.pair), dtype=torch.bool)
        for pair in self.pair.unique():
            rows = (self.settled & (self.pair == pair) & rank.isfinite()).nonzero()[:, 0]
            kept[rows[rank[rows].topk(min(RETURNED, len(rows))).indices]] = True
        return kept


def fit(features: torch.Tensor, outcomes: torch.Tensor, seed: int) -> HoldingScore:
    """A model of the outcomes of these grasps."""
    torch.manual_seed(seed)  # of the initial weights
    generator = torch.Generator().manual_seed(seed)
    model, tried = HoldingScore(len(TRIALS), WIDTH), outcomes.isfinite()
    model.mean = features.nanmean(0)
    model.deviation = (features - model.mean).square().nanmean(0).sqrt() + 1e-3
    optimiser = torch.optim.AdamW(model.layers.parameters(), RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=STEPS)
    share = 1 / tried.sum(0).clamp_min(1)  # each kind of trial counts alike, however many were tried
    for _ in range(STEPS):
        noise = NOISE * model.deviation * torch.randn(features.shape, generator=generator)
        each = functional.binary_cross_entropy_with_logits(model(features + noise), outcomes.nan_to_num(0.0), reduction="none")
        loss = (each * tried * share).sum() / len(TRIALS)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    model.weight = torch.tensor(WEIGHT)
    return model.eval().requires_grad_(False)


def calibrate(rank: torch.Tensor, held: torch.Tensor) -> torch.Tensor:
    """Offset, and slopes below and above zero, of the log-odds by rank: the likeliest, slightly drawn to what it was."""
    free = torch.tensor([0.0, math.log(math.e - 1), math.log(math.e - 1)], requires_grad=True)  # softplus of it is 1
    start, optimiser = free.detach().clone(), torch.optim.LBFGS([free], max_iter=200, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimiser.zero_grad()
        below, above = functional.softplus(free[1:])
        odds = free[0] + below * rank.clamp_max(0) + above * rank.clamp_min(0)
        value = functional.binary_cross_entropy_with_logits(odds, held, reduction="sum") + PRIOR * (free - start).square().sum()
        value.backward()
        return value

    optimiser.step(loss)
    return torch.cat([free[:1], functional.softplus(free[1:])]).detach()


def folds(hands: set[str], seed: int) -> list[set[str]]:
    """Groups of hands; each is left out of one fit."""
    names = sorted(hands)
    random.Random(seed).shuffle(names)
    return [set(names[k::FOLDS]) for k in range(FOLDS) if names[k::FOLDS]]


def left_out_ranks(rows: Rows, hands: set[str], seed: int) -> torch.Tensor:
    """Ranks of the grasps of these hands by fits on the others of them; NaN for grasps of other hands."""
    found = torch.full((len(rows.hand),), torch.nan)
    for out in folds(hands, seed):
        there, inside = rows.of(out), rows.of(hands - out)
        found[there] = fit(rows.features[inside], rows.outcomes[inside], seed).rank(rows.features[there])
    return found


def calibrated_fit(rows: Rows, hands: set[str], seed: int) -> HoldingScore:
    """A model of the grasps of these hands, calibrated on what would be returned for hands that a fit left out."""
    ranks, inside = left_out_ranks(rows, hands, seed), rows.of(hands)
    chosen = rows.returned(ranks)
    model = fit(rows.features[inside], rows.outcomes[inside], seed)
    model.calibration = calibrate(ranks[chosen], rows.outcomes[chosen, 0])
    return model


def judged(rows: Rows, seed: int) -> dict[str, Any]:
    """What nested fits say of hands that they have not seen: how the order is, and how what is told agrees with trials."""
    hands, odds = set(rows.hand), torch.full((len(rows.hand),), torch.nan)
    for out in folds(hands, seed + 1):
        there, model = rows.of(out), calibrated_fit(rows, hands - out, seed)
        odds[there] = model.calibrated(model.rank(rows.features[there]))
    chosen, found = rows.returned(odds), {}
    for name, column in zip(TRIALS, rows.outcomes.unbind(1), strict=True):
        tried = column.isfinite() & rows.settled
        found[name] = {
            "area": roc_area(odds[tried], column[tried] > 0.5),
            "area_before": roc_area(rows.score[tried], column[tried] > 0.5),
            "returned": float(column[tried & chosen].mean()), "of": int((tried & chosen).sum())}
    found["bins"] = reliability(odds[chosen].sigmoid(), rows.outcomes[chosen, 0] > 0.5)
    found["least"] = [price_of_least(odds[chosen].sigmoid(), rows.outcomes[chosen, 0] > 0.5, least) for least in LEVELS]
    return found


def main() -> None:
    """Collect, fit, save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="folder for the grasps")
    parser.add_argument("--weights", default=None, help="weights that predict the grasps; the shipped ones by default")
    parser.add_argument("--ranking", type=Path, default=None, help="weights that rank them; the shipped ones by default")
    parser.add_argument("--hands", nargs="+", default=list(HANDS), help="training hands")
    parser.add_argument("--groups", nargs="+", default=list(GROUPS), help="groups of training objects")
    parser.add_argument("--made", type=int, default=24, help="made-up hands")
    parser.add_argument("--rounds", type=int, default=8, help="objects of each hand")
    parser.add_argument("--num", type=int, default=32, help="candidates of the network for each pair, and half as many others")
    parser.add_argument("--minutes", type=float, default=math.inf, help="when to stop collecting")
    parser.add_argument("--workers", type=int, default=1, help="processes that collect")
    parser.add_argument("--output", type=Path, default=SHIPPED_HOLDING, help="where the model is written")
    parser.add_argument("--collect-only", action="store_true", help="do not fit")
    options = parser.parse_args()
    torch.set_num_threads(1)
    plan = Plan(options.weights, options.ranking, tuple(options.groups), options.num)
    stems = {name: Path(name).stem if Path(name).suffix else name.replace("/", "-")
             for name in hands(options.folder / "hands", options.hands, options.made)}
    tasks = [(options.folder / f"{turn}-{stem}.pt", (name, f"{stem} {turn}"))
             for turn in range(options.rounds) for name, stem in stems.items()]
    fill(collect, plan, tasks, options.workers, options.minutes)
    if options.collect_only:
        return
    rows = Rows.read(options.folder)
    found = judged(rows, SEED)
    print(json.dumps(found, indent=1))
    model = calibrated_fit(rows, set(rows.hand), SEED)
    settings = asdict(plan) | {"ranking": str(plan.ranking or "shipped")}
    about = {
        "stage": "ranking of settled grasps", **made_by(), "settings": settings, "trials": TRIALS, "seed": SEED,
        "rests_on": {"weights": checksum(locate_weights(options.weights)), "ranking": checksum(plan.ranking or SHIPPED)},
        "samples": STEPS * len(rows.hand), "metrics": found,
        "data": {"hands": dict(Counter(rows.hand)), "grasps": len(rows.hand), "pairs": int(rows.pair.max()) + 1,
                 "fingerprint": fingerprint(sorted(options.folder.glob("*.pt")))},
    }
    options.output.parent.mkdir(parents=True, exist_ok=True)
    save_weights(model, options.output, about)


if __name__ == "__main__":
    main()
