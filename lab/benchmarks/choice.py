"""The network alone: the first draw, and the choice among several z and placements.

The choice is made with and without their imbalance, and by all points of the hand at the end or by those of the network alone.

python -m lab.benchmarks.choice [--hands HAND ...] [--objects OBJECT ...] [--num N] [--weights NAME] [--each] [--json]

Diversity is the paper's, over grasps that hold under `dro`, a mean over hands.
"""

from __future__ import annotations

import argparse
import dataclasses
import time

import numpy as np
import torch

from dro_grasp.compare.metrics import diversity
from dro_grasp.compare.stages import pair_seed
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.choice import ChoiceConfig, ChoicePenalties
from dro_grasp.predict.sources.network import ProposalConfig, propose
from dro_grasp.predict.stages import complete
from dro_grasp.simulation.trial import simulate
from lab.benchmarks.report import emit, rate

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
    "1 x 32, without imbalance": ChoiceConfig(1, 32, penalties=BLIND),
    "1 x 32": ChoiceConfig(1, 32),
    "2 x 16, without imbalance": ChoiceConfig(2, 16, penalties=BLIND),
    "2 x 16, by the network's points": ChoiceConfig(2, 16, finalists=1),
    "2 x 16": ChoiceConfig(2, 16),
    "4 x 4": ChoiceConfig(4, 4),
    "4 x 8": ChoiceConfig(4, 8),
}
"""What each row chooses among: placements x z."""


@dataclasses.dataclass
class Tally:
    """What was found of one hand."""

    held: dict[str, list[bool]] = dataclasses.field(default_factory=lambda: {name: [] for name in PROTOCOLS})
    kept: list[GraspBatch] = dataclasses.field(default_factory=list)
    """Those that hold under the first of the protocols, of each object."""
    seconds: float = 0.0

    def diversity(self) -> float:
        """Of those that hold; 0 if there are fewer than two."""
        kept = GraspBatch.concatenate(self.kept)
        return diversity(kept.T_object_wrist, kept.joints)["all"]


def cells(tallies: list[Tally]) -> list[object]:
    """Number, success with its interval for each protocol, diversity, and time, of one hand or of several."""
    held = [[success for tally in tallies for success in tally.held[name]] for name in PROTOCOLS]
    n = len(held[0])
    return [n, *map(rate, held), float(np.mean([tally.diversity() for tally in tallies])),
            1e3 * sum(tally.seconds for tally in tallies) / n]


@torch.no_grad()
def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hands", nargs="+", default=["allegro", "barrett", "shadowhand"])
    parser.add_argument("--objects", nargs="+", default=OBJECTS)
    parser.add_argument("--num", type=int, default=20, help="grasps of each hand on each object")
    parser.add_argument("--weights", help="weights of the network; the default ones without")
    parser.add_argument("--each", action="store_true", help="rows of each hand, too")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    torch.set_num_threads(1)
    network = GraspPredictor(options.weights).network
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
                tally = found.setdefault((row, hand.name), Tally())
                tally.seconds += seconds
                for name in PROTOCOLS:
                    success = simulate(hand, obj, complete(problem, grasps), name).success
                    tally.held[name] += success.tolist()
                    if name == PROTOCOLS[0]:
                        tally.kept.append(grasps[success])
    names = list(dict.fromkeys(name for _, name in found))
    rows: list[list[object]] = []
    for row in ROWS:
        of = {name: [found[row, name]] for name in names}
        shown = {**(of if options.each else {}), ALL: [tally for (tally,) in of.values()]}
        rows += [[row, name, *cells(tallies)] for name, tallies in shown.items()]
    columns = ["placements x z", "hand", "n", *(f"{name} [%]" for name in PROTOCOLS), "diversity", "CPU ms a grasp"]
    emit("choice of placement and z", rows, columns,
         {f"{row[0]} / {row[1]}": dict(zip(columns[2:], row[2:], strict=True)) for row in rows}, options.json)


if __name__ == "__main__":
    main()
