"""The network alone with one, two or more z decoded for each placement, of whose hands the best is kept by geometry.

    python benchmarks/decoded_choice.py [--hands HAND ...] [--objects OBJECT ...] [--decoded N ...] [--num N] [--json]

All rows have the same placements and draws.
"""

from __future__ import annotations

import argparse
import dataclasses
import time

import torch
from report import emit, rate

from dro_grasp.evaluation.success_rates import pair_seed
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.pipeline.choice import ChoiceConfig
from dro_grasp.pipeline.problem import GraspProblem
from dro_grasp.pipeline.proposal import ProposalConfig, propose
from dro_grasp.pipeline.stages import complete
from dro_grasp.predictor import GraspPredictor
from dro_grasp.simulation.trial import simulate

OBJECTS = ["bottle", "wrench", "bowl", "toy_airplane", "rod", "tall_box"]
"""Built-in training objects; rod, toy_airplane and wrench are among the eight by which the penalties were fitted."""
PROTOCOLS = ("dro", "strict")
"""Trials of every grasp."""
ALL = "all"
"""The row over all hands."""


@dataclasses.dataclass
class Tally:
    """What was found of one hand, or of all of them."""

    held: dict[str, list[bool]] = dataclasses.field(default_factory=lambda: {name: [] for name in PROTOCOLS})
    seconds: float = 0.0

    def cells(self) -> list[object]:
        """Number, success with its interval for each protocol, and time."""
        n = len(self.held[PROTOCOLS[0]])
        return [n, *map(rate, self.held.values()), 1e3 * self.seconds / n]


@torch.no_grad()
def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hands", nargs="+", default=["allegro", "barrett", "shadowhand"])
    parser.add_argument("--objects", nargs="+", default=OBJECTS)
    parser.add_argument("--decoded", nargs="+", type=int, default=[1, 2, 3, 4], help="z that are decoded; a row for each")
    parser.add_argument("--num", type=int, default=20, help="grasps of each hand on each object")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    torch.set_num_threads(1)
    network = GraspPredictor().network
    configs = {k: ProposalConfig(choice=ChoiceConfig(decoded=k)) for k in options.decoded}
    found: dict[tuple[int, str], Tally] = {}
    for hand in map(load_hand, options.hands):
        for obj in map(load_object, resolve_objects(options.objects)):
            problem, seed = GraspProblem(hand, obj), pair_seed(0, hand, obj)
            assert problem.field is not None  # made before the clock runs
            for decoded, config in configs.items():
                start = time.process_time()
                grasps = propose(problem, network, options.num, torch.Generator().manual_seed(seed), config).grasps
                seconds = time.process_time() - start
                outcomes = {name: simulate(hand, obj, complete(problem, grasps), name).success.tolist() for name in PROTOCOLS}
                for tally in (found.setdefault((decoded, row), Tally()) for row in (hand.name, ALL)):
                    tally.seconds += seconds
                    for name, held in outcomes.items():
                        tally.held[name] += held
    rows = [[decoded, name, *tally.cells()] for (decoded, name), tally in sorted(found.items(), key=lambda item: item[0][0])]
    columns = ["decoded", "hand", "n", *(f"{name} [%]" for name in PROTOCOLS), "CPU ms a grasp"]
    emit("z decoded for each placement", rows, columns,
         {f"{row[0]} / {row[1]}": dict(zip(columns[2:], row[2:], strict=True)) for row in rows}, options.json)


if __name__ == "__main__":
    main()
