"""The network alone: the first draw, and the choice among several z and placements, with and without their imbalance.

python benchmarks/choice.py [--hands HAND ...] [--objects OBJECT ...] [--num N] [--each] [--json]
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
from dro_grasp.pipeline.choice import ChoiceConfig, ChoicePenalties
from dro_grasp.pipeline.problem import GraspProblem
from dro_grasp.pipeline.proposal import ProposalConfig, propose
from dro_grasp.pipeline.stages import complete
from dro_grasp.predictor import GraspPredictor
from dro_grasp.simulation.trial import simulate

OBJECTS = ["jar", "rod", "toy_airplane", "wrench", "vase", "joystick", "brick", "egg"]
"""Built-in training objects, on which the penalties were chosen."""
PROTOCOLS = ("dro", "strict")
"""Trials of every grasp."""
ALL = "all"
"""The row over all hands."""
BLIND = dataclasses.replace(ChoicePenalties(), imbalance=0.0)
"""Today's other penalties, which do not ask whether the fingers' pushes cancel."""
ROWS = {
    "first draw": ChoiceConfig.first(),
    "1 x 32, without imbalance": ChoiceConfig(1, 32, BLIND),
    "1 x 32": ChoiceConfig(1, 32),
    "2 x 16, without imbalance": ChoiceConfig(2, 16, BLIND),
    "2 x 16": ChoiceConfig(2, 16),
    "4 x 8": ChoiceConfig(4, 8),
}
"""What each row chooses among: placements x z."""


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
    parser.add_argument("--num", type=int, default=20, help="grasps of each hand on each object")
    parser.add_argument("--each", action="store_true", help="rows of each hand, too")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    torch.set_num_threads(1)
    network = GraspPredictor().network
    found: dict[tuple[str, str], Tally] = {}
    for hand in map(load_hand, options.hands):
        for obj in map(load_object, resolve_objects(options.objects)):
            problem, seed = GraspProblem(hand, obj), pair_seed(0, hand, obj)
            assert problem.field is not None  # made before the clock runs
            for row, choice in ROWS.items():
                start = time.process_time()
                generator = torch.Generator().manual_seed(seed)
                grasps = propose(problem, network, options.num, generator, ProposalConfig(choice=choice)).grasps
                seconds = time.process_time() - start
                outcomes = {name: simulate(hand, obj, complete(problem, grasps), name).success.tolist() for name in PROTOCOLS}
                for tally in (found.setdefault((row, of), Tally()) for of in ((hand.name, ALL) if options.each else (ALL,))):
                    tally.seconds += seconds
                    for name, held in outcomes.items():
                        tally.held[name] += held
    ordered = sorted(found.items(), key=lambda item: list(ROWS).index(item[0][0]))
    rows = [[row, name, *tally.cells()] for (row, name), tally in ordered]
    columns = ["placements x z", "hand", "n", *(f"{name} [%]" for name in PROTOCOLS), "CPU ms a grasp"]
    emit("choice of placement and z", rows, columns,
         {f"{row[0]} / {row[1]}": dict(zip(columns[2:], row[2:], strict=True)) for row in rows}, options.json)


if __name__ == "__main__":
    main()
