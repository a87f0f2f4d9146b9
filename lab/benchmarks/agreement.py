"""How many outcomes of trials stay the same with finer time steps and other settings of the solver.

    python -m lab.benchmarks.agreement [--hands HAND ...] [--objects NAME ...] [--num N] [--protocols NAME ...] [--json]

Grasps are the network's, refined and settled, all of them: the best alone hold nearly always, and would agree for that reason.
So both outcomes occur, and `kappa` says how far the agreement is beyond that of chance.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from dro_grasp.compare.methods import Method
from dro_grasp.compare.stages import pair_seed
from dro_grasp.devices import cores
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.finish import finish
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.settling import SettleConfig
from dro_grasp.simulation.protocols import protocol
from dro_grasp.simulation.trial import simulate
from lab.benchmarks.report import emit, options_of, rate

CHANGES = {
    "1 ms": {"timestep": 0.001},
    "friction ten times stiffer": {"impratio": 100.0},
    "residual slip removed longer": {"noslip": 10},
}
"""Settings of the simulation that should not matter, by name; the protocol's are the first row (ours)."""
HANDS = ("assets/barrett_multidex", "assets/allegro_left", "assets/shadowhand")
"""The paper hands."""
COLUMNS = ("protocol", "setting", "trials", "held", "held [%]", "same", "same [%]", "kappa")


def candidates(predictor: GraspPredictor, hand: Hand, obj: ObjectModel, num: int, seed: int) -> GraspBatch:
    """The network's grasps of a pair, refined and settled, the good and the bad."""
    problem, method = GraspProblem(hand, obj), Method("network", predictor)
    rules = predictor.config.finish
    made = method.propose(problem, num, pair_seed(seed, hand, obj))
    return finish(problem, made, replace(rules, settle=replace(rules.settle or SettleConfig(), share=1.0)), num).grasps


def outcomes(options: argparse.Namespace) -> Iterator[dict[tuple[str, str], Bool[Tensor, " n"]]]:
    """Of each pair whether its grasps hold, by protocol and setting."""
    predictor = GraspPredictor()
    for name in options.hands:
        hand = load_hand(name)
        for obj in map(load_object, resolve_objects(options.objects)):
            grasps = candidates(predictor, hand, obj, options.num, options.seed)
            print(f"{hand.name} on {obj.name}", file=sys.stderr)
            yield {(p, setting): simulate(hand, obj, grasps, replace(protocol(p), **change), workers=options.workers).success
                   for p in options.protocols for setting, change in {"its own": {}, **CHANGES}.items()}


def kappa(one: Bool[Tensor, " n"], other: Bool[Tensor, " n"]) -> float:
    """Agreement beyond chance; 1 where two judges always agree. Source: Cohen 1960."""
    a, b = float(one.double().mean()), float(other.double().mean())
    chance = a * b + (1 - a) * (1 - b)
    return 1.0 if chance == 1 else (float((one == other).double().mean()) - chance) / (1 - chance)


def row(name: str, setting: str, usual: Bool[Tensor, " n"], found: Bool[Tensor, " n"]) -> list[object]:
    """A line of the table: what holds with a setting, and for how many grasps this is the same."""
    same = usual == found
    return [name, setting, len(found), int(found.sum()), rate(found), int(same.sum()), rate(same), kappa(usual, found)]


def main(argv: list[str] | None = None) -> None:
    """Measure and print."""
    parser = options_of(__doc__)
    parser.add_argument("--hands", nargs="+", default=list(HANDS))
    parser.add_argument("--objects", nargs="+", default=["assets:validate"])
    parser.add_argument("--num", type=int, default=8, help="grasps of each hand on each object")
    parser.add_argument("--protocols", nargs="+", default=["carry", "strict"])
    parser.add_argument("--seed", type=int, default=0, help="of the grasps")
    parser.add_argument("--workers", type=int, default=cores(), help="threads of the trials")
    options = parser.parse_args(argv)
    found = list(outcomes(options))
    joined = {key: torch.cat([pair[key] for pair in found]) for key in found[0]}
    lines = [row(name, setting, joined[name, "its own"], held) for (name, setting), held in joined.items()]
    emit(f"{options.num} settled grasps of each of {len(options.hands)} hands on each of {len(found) // len(options.hands)} "
         f"objects (seed {options.seed})", lines, COLUMNS,
         {"rows": [dict(zip(COLUMNS, line, strict=True)) for line in lines]}, options.json)


if __name__ == "__main__":
    main()
