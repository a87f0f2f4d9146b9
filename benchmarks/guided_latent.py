"""z chosen among draws, beside z that also climbs the gradient of the score it is chosen by: the network alone.

    python benchmarks/guided_latent.py [--hands HAND ...] [--objects OBJECT ...] [--num N] [--json]

The best `KEPT` of the draws climb by Adam, as far as a penalty for leaving the draw lets them; the best point on the way is
decoded. All rows have the same placements.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace

import torch
from report import emit
from torch import Tensor

from dro_grasp.compare.stages import pair_seed
from dro_grasp.hands.library import load_hand
from dro_grasp.models.network import DistanceNetwork, Moves
from dro_grasp.objects.catalogue import load_object
from dro_grasp.predict.config import PredictorConfig
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.choice import ChoiceConfig, choice_scores
from dro_grasp.predict.stages import complete
from dro_grasp.simulation.trial import simulate

OBJECTS = ["bottle", "wrench", "bowl", "toy_airplane", "rod", "tall_box"]
"""Built-in training objects."""
KEPT = 4
"""Draws that climb."""


@dataclass(frozen=True)
class Ascent:
    """How z climbs."""

    draws: int = 16
    """Draws of z for each placement."""
    steps: int = 0
    """Adam's steps; 0 keeps the best draw."""
    rate: float = 0.05
    """Adam's rate, in z."""
    penalty: float = 0.0
    """Weight of the squared distance from the draw."""


class GuidedNetwork(DistanceNetwork):
    """The network, whose z climbs the suitability of the moved hand."""

    ascent = Ascent()
    """How z climbs."""
    problem: GraspProblem
    """Hand and object."""
    reached: list[Tensor]
    """Suitability of the best hands."""

    def to_frame(self, points: Tensor, centre: Tensor, rotation: Tensor) -> Tensor:
        """As the network's; remembered, because suitability is judged in the object's frame."""
        self.frame = centre, rotation
        return super().to_frame(points, centre, rotation)

    def move(self, hand: Tensor, obj: Tensor, noise: Tensor) -> Moves:
        """As the network's, after the ascent of the best draws."""
        moves = super().move(hand, obj, noise)
        suits = self._suit(moves.points)
        if self.ascent.steps:
            rows = torch.arange(len(hand))[:, None]
            z = self._climbed(moves.hand_features, hand, moves.z[rows, suits.topk(KEPT, 1).indices])
            assert self.motion is not None
            moves = replace(moves, z=z, points=self.motion(moves.hand_features, hand, z))
            suits = self._suit(moves.points)
        self.reached.append(suits.amax(1))
        return moves

    def _suit(self, points: Tensor) -> Tensor:
        centre, rotation = self.frame
        hand = self.problem.thinned(self.config.n_hand)
        placed = points @ rotation[:, None].mT + centre[:, None, None]
        return choice_scores(hand, self.problem.field, placed, ChoiceConfig().penalties)

    @torch.enable_grad()
    def _climbed(self, phi_hand: Tensor, hand: Tensor, start: Tensor) -> Tensor:
        assert self.motion is not None
        z = start.clone().requires_grad_(True)
        adam, best, found = torch.optim.Adam([z], lr=self.ascent.rate), torch.full(z.shape[:2], -torch.inf), start.clone()
        for _ in range(self.ascent.steps + 1):
            value = self._suit(self.motion(phi_hand, hand, z)) - self.ascent.penalty * (z - start).square().sum(-1)
            better = value.detach() > best
            best, found = torch.where(better, value.detach(), best), torch.where(better[..., None], z.detach(), found)
            adam.zero_grad()
            (-value.sum()).backward()
            adam.step()
        return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hands", nargs="+", default=["allegro", "barrett", "shadowhand"])
    parser.add_argument("--objects", nargs="+", default=OBJECTS)
    parser.add_argument("--num", type=int, default=12, help="grasps of each hand on each object")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    torch.set_num_threads(1)
    shipped = GraspPredictor()
    network = GuidedNetwork(shipped.network.config, shipped.network.name)
    network.load_state_dict(shipped.network.state_dict())
    shipped.network = network.requires_grad_(False).eval()
    pairs = [(load_hand(hand), load_object(obj)) for hand in options.hands for obj in options.objects]
    columns = ["draws", "steps", "penalty", "n", "dro [%]", "strict [%]", "suitability", "CPU ms a grasp"]
    rows: list[list[object]] = []
    for ascent in (Ascent(), Ascent(draws=64), Ascent(steps=10), Ascent(steps=10, penalty=0.3),
                   Ascent(steps=20, rate=0.1, penalty=0.1)):
        network.ascent, network.reached = ascent, []
        held: dict[str, list[Tensor]] = {"dro": [], "strict": []}
        seconds = 0.0
        config = PredictorConfig()
        shipped.config = replace(config, choice=replace(config.choice, draws=ascent.draws))
        for hand, obj in pairs:
            problem = network.problem = GraspProblem(hand, obj)
            assert problem.field is not None  # made before the clock runs
            start = time.process_time()
            grasps = shipped.predict(
                hand, obj, options.num, pair_seed(0, hand, obj), candidates=1, refine=False, source="network")
            seconds += time.process_time() - start
            for name, found in held.items():
                found.append(simulate(hand, obj, complete(problem, grasps), name, workers=1).success.double())
        success = {name: torch.cat(found) for name, found in held.items()}
        n = len(success["dro"])
        rows.append([ascent.draws, ascent.steps, ascent.penalty, n, *(100 * float(s.mean()) for s in success.values()),
                     float(torch.cat(network.reached).mean()), 1e3 * seconds / n])
    emit("z chosen, and z guided", rows, columns, {
        f"draws {r[0]}, steps {r[1]}, penalty {r[2]}": dict(zip(columns[3:], r[3:], strict=True)) for r in rows}, options.json)


if __name__ == "__main__":
    main()
