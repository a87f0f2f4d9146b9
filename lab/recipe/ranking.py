"""Train the network that ranks grasps on the outcomes of trials of predicted grasps on training objects.

    python -m lab.recipe.ranking --folder FOLDER [--weights FILE] [--output FILE] [--num N] [--objects N] [--collect-only]

Grasps are drawn at several temperatures. Most are evaluated settled, the network's and the optimiser's; some refined, raw,
shaken, opened and moved away. Some features come from a depth image or half of a cloud. `--hands` also takes files, such as
those of `dro-grasp hand make`. The folder keeps the trials of each hand, so a stopped script resumes. The network with the
lowest loss on objects left out is written. Assets are needed where hands or objects are of them.
"""

from __future__ import annotations

import argparse
import math
import random
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args
from zlib import crc32

import torch
from torch import Tensor
from torch.nn import functional

from dro_grasp.compare.metrics import roc_area
from dro_grasp.geometry.se3 import roma
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.network.checkpoints import DEFAULT, load_weights, locate_weights
from dro_grasp.network.completion_network import SHIPPED as SHIPPED_SURFACE, load_surface
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.objects.perception.partial_views import View, partial_view
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimize.grasp_energy import GraspEnergy
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.score.features import feature_names, grasp_features
from dro_grasp.predict.score.score import SHIPPED, ScoreConfig, ScoreNetwork, save_score_network
from dro_grasp.predict.settling import settle_all
from dro_grasp.predict.sources.network import ProposalConfig, propose
from dro_grasp.predict.sources.optimiser import OptimiserSource
from dro_grasp.predict.stages import complete, refine
from dro_grasp.provenance import made_by
from dro_grasp.simulation.trial import simulate
from lab.recipe.parts import checksum, fill, fingerprint

HANDS = ("assets/barrett_multidex", "assets/allegro_left", "assets/shadowhand", "assets/leaphand", "assets/allegro_right",
         "allegro", "barrett", "gripper3", "leaphand", "shadowhand")
"""Training hands."""
TRIALS = ("strict", "dexgraspbench")
"""Protocols whose outcome the network predicts, where no others are asked for; the score is the mean of their log-odds."""
GROUPS = ("assets:train",)
"""Objects, where no others are asked for."""
FEATURES = f"{crc32(repr(feature_names()).encode()):08x}"
"""Part of the names of stored trials: trials stored with other features are not used."""
TEMPERATURES = (0.2, 0.5, 0.8, 1.0)
"""Temperatures of z, one drawn for each object."""
SHAKE = (0.01, 0.15, 0.2)
"""Standard deviations of a shaken grasp's shift [m], turn [rad] and joints [rad], times a number up to 2."""
LEFT_OUT = 6
"""One in so many training objects is left out of the fit; these select its best step."""
STEPS = 4000
"""Steps of the fit."""
SETTLED_WEIGHT = 3.0
"""How much more often settled grasps are drawn than others: these are what is ranked in the end."""
BATCH = 256
"""Grasps in a step."""
RATE = 2e-3
"""Peak learning rate."""
DECAY = 0.05
"""Weight decay."""
FINISHED = ("refined", "settled", "optimised", "optimised, settled")
"""Kinds of grasps that a request ranks, by which a fit is judged."""
NOISE = 0.05
"""Standard deviation of the noise on link features."""


def shaken(hand: Hand, grasps: GraspBatch, generator: torch.Generator) -> GraspBatch:
    """Grasps with wrist and joints perturbed: the network must know failures too."""
    T, n = grasps.T_object_wrist.clone(), len(grasps)
    strength = 2 * torch.rand(n, 1, generator=generator)
    move, turn, bend = (
        torch.randn(n, k, generator=generator) * s * strength for k, s in zip((3, 3, hand.tree.n_dof), SHAKE, strict=True))
    T[:, :3, :3] = roma.rotvec_to_rotmat(turn) @ T[:, :3, :3]
    T[:, :3, 3] += hand.grasp_centres(grasps.T_object_wrist) - hand.grasp_centres(T) + move
    q = (grasps.joints + bend * hand.tree.joint_unit * hand.movable).clamp(hand.tree.lower, hand.tree.upper)
    return grasps.with_poses(T, q)


def away(grasps: GraspBatch, generator: torch.Generator) -> GraspBatch:
    """Grasps of air: the hand is 5 to 40 cm off in any direction."""
    T = grasps.T_object_wrist.clone()
    direction = functional.normalize(torch.randn(len(T), 3, generator=generator), dim=-1)
    T[:, :3, 3] += direction * (0.05 + 0.35 * torch.rand(len(T), 1, generator=generator))
    return grasps.with_poses(T, grasps.joints)


@torch.no_grad()
def evaluated(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, known: ObjectModel, trials: Sequence[str]
) -> dict[str, Tensor]:
    """Features of grasps from the known part of the object, and outcomes of their trials on the whole object."""
    energy = GraspEnergy.of_object(hand, known, ScoreConfig().energy)
    features = grasp_features(energy, grasps, energy(grasps.T_object_wrist, grasps.joints).terms)
    outcomes = torch.stack([simulate(hand, obj, grasps, rules, another=True).success for rules in trials], 1)
    return {**features._asdict(), "outcomes": outcomes.float()}


@dataclass(frozen=True)
class Plan:
    """What is collected of each hand."""

    weights: str | None  # that predict the grasps
    surface: Path  # weights that complete what is seen in part
    groups: tuple[str, ...]  # of objects
    objects: int  # of each hand
    num: int  # predicted grasps of each
    views: tuple[View, ...]
    trials: tuple[str, ...]
    seed: int


def drawn(plan: Plan, name: str) -> list[str]:
    """The objects of a hand."""
    labels = resolve_objects(list(plan.groups))
    return random.Random(f"{name} {plan.seed}").sample(labels, min(plan.objects, len(labels)))


def collect(plan: Plan, given: tuple[str, str]) -> tuple[list[dict[str, Any]], str]:
    """Trials of a hand on a training object, given by their names, and what to print of them."""
    name, label = given
    hand, obj, rng = load_hand(name), load_object(label), random.Random(f"{name} {label} {plan.seed}")
    num, generator = plan.num, torch.Generator().manual_seed(rng.randrange(10**6))
    config = ProposalConfig(temperature=rng.choice(TEMPERATURES))
    view = rng.choice(plan.views)
    known = partial_view(obj, view, rng.randrange(10**6), network=load_surface(plan.surface))
    problem = GraspProblem(hand, known)
    # Proposed without ranking: the network in use must neither choose its successor's data nor know its features.
    proposal = propose(problem, load_weights(plan.weights), num, generator, config=config)
    raw, refined = complete(problem, proposal.grasps), refine(problem, proposal.grasps)
    best = refine(problem, OptimiserSource().propose(problem, num, rng.randrange(10**6)).grasps)
    # Closing is simulated with the whole object, as `generate` does; on a bare cloud it is left out.
    whole = GraspProblem(hand, obj)
    kinds = "settled", "optimised, settled"
    closed = {kind: settle_all([whole], [grasps])[0] for kind, grasps in zip(kinds, (refined, best), strict=True)}
    some = refined[slice(0, num // 8)]
    opened = hand.canonical_joints(1.0).expand_as(some.joints)
    groups = {
        "raw": raw[slice(0, num // 8)], "refined": refined[slice(0, num // 2)], "optimised": best[slice(0, num // 2)],
        **{kind: found.grasps[found.stable] for kind, found in closed.items()},
        "shaken": shaken(hand, refined[slice(0, num // 4)], generator),
        "opened": some.with_poses(some.T_object_wrist, opened), "away": away(some, generator),
    }
    about = {"hand": hand.name, "object": label, "view": view}
    parts = [{**about, "kind": kind, **evaluated(hand, obj, grasps, known, plan.trials)}
             for kind, grasps in groups.items() if len(grasps)]  # all optimised ones may have lost the object
    return parts, f"{view} view, {sum(len(part['whole']) for part in parts)} grasps"


def joined(parts: list[dict[str, Any]]) -> dict[str, Tensor]:
    """All grasps in one table; hands with fewer links are padded, and the padding has no effect."""
    most = max(part["links"].shape[1] for part in parts)
    columns = {}
    for key in ("links", "nearness", "whole", "outcomes"):
        rows = [part[key] for part in parts]
        if key == "links":
            # The network takes a maximum over links: padding repeats the first link.
            rows = [torch.cat([r, r[:, :1].expand(-1, most - r.shape[1], -1)], 1) for r in rows]
        if key == "nearness":
            rows = [functional.pad(r, (0, most - r.shape[1])) for r in rows]
        columns[key] = torch.cat(rows)
    return columns


def areas(network: ScoreNetwork, parts: list[dict[str, Any]]) -> list[float]:
    """Mean area under the ROC curve within groups, for each protocol."""
    with torch.no_grad():
        found = [[roc_area(network(p["links"], p["nearness"], p["whole"])[:, k], p["outcomes"][:, k] > 0.5) for p in parts]
                 for k in range(parts[0]["outcomes"].shape[1] if parts else 0)]
    return [sum(x for x in a if x == x) / max(1, sum(x == x for x in a)) for a in found]


def fit(parts: list[dict[str, Any]], left_out: set[str], seed: int, steps: int) -> tuple[ScoreNetwork, list[float], float]:
    """The network at its best step on objects left out, with its ROC areas and its loss there."""
    torch.manual_seed(seed)  # of the initial weights
    generator = torch.Generator().manual_seed(seed)
    train = joined([p for p in parts if p["object"] not in left_out])
    others = [p for p in parts if p["object"] in left_out]
    check = joined(others)
    network = ScoreNetwork(train["outcomes"].shape[1])
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps)
    chance = torch.cat([torch.full((len(p["whole"]),), SETTLED_WEIGHT if "settled" in p["kind"] else 1.0)
                        for p in parts if p["object"] not in left_out])
    best, best_state = float("inf"), network.state_dict()
    for step in range(1, steps + 1):
        rows = torch.multinomial(chance, min(BATCH, len(chance)), generator=generator)
        links, nearness, whole, outcomes = (train[k][rows] for k in ("links", "nearness", "whole", "outcomes"))
        links = links + NOISE * torch.randn(links.shape, generator=generator)
        loss = functional.binary_cross_entropy_with_logits(network(links, nearness, whole), outcomes)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        if step % 100 == 0 or step == steps:
            with torch.no_grad():
                now = float(functional.binary_cross_entropy_with_logits(
                    network(check["links"], check["nearness"], check["whole"]), check["outcomes"]))
            if now < best:
                best, best_state = now, {k: v.clone() for k, v in network.state_dict().items()}
    network.load_state_dict(best_state)
    return network.eval(), areas(network, [p for p in others if p["kind"] in FINISHED]), best


def main() -> None:
    """Collect, fit, save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="folder for the trials")
    parser.add_argument("--weights", default=None, help="weights that predict the grasps; the shipped ones by default")
    parser.add_argument("--surface", type=Path, default=SHIPPED_SURFACE, help="weights that complete what is seen in part")
    parser.add_argument("--output", type=Path, default=SHIPPED, help="where the network is written")
    parser.add_argument("--hands", nargs="+", default=list(HANDS), help="hands to collect trials of")
    parser.add_argument("--groups", nargs="+", default=list(GROUPS), help="training objects")
    parser.add_argument("--objects", type=int, default=16, help="of these for each hand")
    parser.add_argument("--num", type=int, default=16, help="predicted grasps of each")
    parser.add_argument("--trials", nargs="+", default=list(TRIALS), help="protocols whose outcome is predicted")
    parser.add_argument("--views", nargs="+", choices=get_args(View), default=["whole", "whole", "half", "depth"],
                        help="views of the objects; naming one twice doubles its share")
    parser.add_argument("--steps", type=int, default=STEPS, help="steps of the fit")
    parser.add_argument("--workers", type=int, default=1, help="processes that collect")
    parser.add_argument("--seed", type=int, default=0, help="seed of everything")
    parser.add_argument("--collect-only", action="store_true", help="do not fit")
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.folder.mkdir(parents=True, exist_ok=True)
    plan = Plan(options.weights, options.surface, tuple(options.groups), options.objects, options.num, tuple(options.views),
                tuple(options.trials), options.seed)
    stems = {name: Path(name).stem if Path(name).suffix else name.replace("/", "-") for name in options.hands}
    fill(collect, plan, [(options.folder / f"{stem}-{label.replace('/', '-')}-{plan.seed}-{FEATURES}.pt", (name, label))
                         for name, stem in stems.items() for label in drawn(plan, name)], options.workers)
    if options.collect_only:
        return
    files = sorted(options.folder.glob(f"*-{FEATURES}.pt"))
    parts = [part for path in files for part in torch.load(path, weights_only=True)]
    names = sorted({part["object"] for part in parts})
    left_out = set(random.Random(0).sample(names, math.ceil(len(names) / LEFT_OUT)))
    network, found, loss = fit(parts, left_out, plan.seed, options.steps)
    print(f"{sum(len(p['whole']) for p in parts)} grasps; objects left out: loss {loss:.3f}, ROC area of refined grasps "
          + ", ".join(f"{rules} {area:.3f}" for rules, area in zip(plan.trials, found, strict=True)))
    about = {
        "stage": "ranking", **made_by(), "weights": options.weights or DEFAULT,
        "settings": asdict(plan) | {"surface": str(plan.surface)},
        "rests_on": {"weights": checksum(locate_weights(options.weights)), "surface": checksum(plan.surface)},
        "steps": options.steps, "trials": plan.trials, "seed": plan.seed, "left_out": sorted(left_out),
        "samples": BATCH * options.steps, "metrics": {"loss": loss, "areas": dict(zip(plan.trials, found, strict=True))},
        "data": {"hands": dict(Counter(p["hand"] for p in parts for _ in p["whole"])), "objects": len(names),
                 "grasps": sum(len(p["whole"]) for p in parts), "fingerprint": fingerprint(files)},
    }
    options.output.parent.mkdir(parents=True, exist_ok=True)
    save_score_network(network, options.output, about)


if __name__ == "__main__":
    main()
