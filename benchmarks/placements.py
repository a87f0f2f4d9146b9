"""Where a placement prior puts hands that it has never seen: by features that a network learned, or by the hand's proportions.

    python benchmarks/placements.py --bundle real.safetensors --more both.safetensors --held-out unseen.safetensors
        [--hands HAND ...] [--objects NAME ...] [--json]

Trains the placement prior of a network anew, nothing else, and compares its likeliest positions with those of stored grasps: of
hands that it was not trained on (`dataset bundle --split few_shot`). With `--hands`, the network alone, with each of these
priors, proposes grasps of these hands, which are tried.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import torch
from report import emit, rate
from torch import Tensor

from dro_grasp.compare.stages import pair_seed
from dro_grasp.datasets.bundle.training_file import Bundle, load_bundle
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.hands.proportions import proportions
from dro_grasp.models.checkpoints import load_weights
from dro_grasp.models.network import DistanceNetwork, untrained_network
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.network import propose
from dro_grasp.predict.stages import complete
from dro_grasp.simulation.trial import simulate
from dro_grasp.training.config import AugmentationConfig, PlacementConfig
from dro_grasp.training.placement_training import train_placement
from dro_grasp.training.samples import SampleSource

Form = Literal["features", "proportions"]
"""What a prior is told of a hand."""
OTHER: dict[Form, Form] = {"features": "proportions", "proportions": "features"}
"""The other form."""
PROTOCOLS = ("dro", "strict")
"""Trials of proposed grasps."""
SHIPPED = "as shipped"
"""The row of the shipped prior."""


class Variant:
    """A network whose placement prior was trained anew."""

    def __init__(self, network: DistanceNetwork) -> None:
        assert network.placement is not None
        self.network, self.prior = network, network.placement

    @staticmethod
    def fitted(network: DistanceNetwork, form: Form, bundle: Bundle, steps: int) -> Variant:
        """The network with a prior that takes `features` or `proportions`, trained on a bundle."""
        # A prior of the other form is not taken over: the one of this form begins anew.
        given = untrained_network(replace(network.config, placement_hand=OTHER[form]), seed=0)
        given.load_state_dict({k: v for k, v in network.state_dict().items() if not k.startswith("placement.")}, strict=False)
        config = PlacementConfig(replace(PlacementConfig().schedule, steps=steps))
        with TemporaryDirectory() as folder:
            wanted = replace(network.config, placement_hand=form)
            return Variant(train_placement(bundle, wanted, config, Path(folder), given))

    @torch.no_grad()
    def describe(self, hand: Hand) -> Tensor:
        """What the prior is told of a hand."""
        axes = self.network.config.axes(hand.palm_axes_wrist)
        if self.prior.standardised is not None:
            return proportions(hand, axes)
        opened = hand.points(hand.canonical_joints()) @ axes
        return self.network.hand_encoder((opened - opened.mean(0))[None]).mean(1)[0]

    @torch.no_grad()
    def errors(self, source: SampleSource, count: int) -> dict[str, tuple[float, float]]:
        """By hand: the median distance from the likeliest position to the true one [mm], and its mean log-density [nat]."""
        generator, found = torch.Generator().manual_seed(5), {}
        for name in sorted(source.names):
            group = source.draw(name, count, generator)
            hand = self.describe(source.hands[name]).expand(count, -1)
            logits, mean, _, _ = self.prior(group.obj_hand, hand)
            likeliest = mean[torch.arange(count), logits.argmax(-1)]
            density, _ = self.prior.log_density(group.obj_hand, hand, group.position)
            found[name] = (1e3 * float((likeliest - group.position).norm(dim=-1).median()), float(density.mean()))
        return found

    @torch.no_grad()
    def held(self, hand: Hand, name: str, num: int) -> Tensor:
        """Outcomes of proposals for an object, a column for each protocol."""
        obj = load_object(name)
        problem = GraspProblem(hand, obj)
        grasps = propose(problem, self.network, num, torch.Generator().manual_seed(pair_seed(0, hand, obj))).grasps
        grasps = complete(problem, grasps)
        return torch.stack([simulate(hand, obj, grasps, protocol).success for protocol in PROTOCOLS], 1)


def main() -> None:
    """Train, compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bundle", required=True, type=Path, help="grasps of the hands in training")
    parser.add_argument("--more", type=Path, help="grasps of these and further hands, for two rows more")
    parser.add_argument("--held-out", required=True, type=Path, help="grasps of hands that were not trained on")
    parser.add_argument("--weights", help="network whose prior is trained anew; the default weights")
    parser.add_argument("--steps", type=int, default=2000, help="training steps of 96 grasps")
    parser.add_argument("--samples", type=int, default=300, help="stored grasps of each hand")
    parser.add_argument("--hands", nargs="+", default=[], help="hands to propose grasps for")
    parser.add_argument("--objects", nargs="+", default=["jar", "rod", "vase", "brick", "egg", "cone"], help="their objects")
    parser.add_argument("--num", type=int, default=8, help="grasps of each of these pairs")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    network = load_weights(options.weights).eval()
    unseen = SampleSource(load_bundle(options.held_out), network.config, AugmentationConfig())
    bundles = {"": options.bundle} | ({", more hands": options.more} if options.more is not None else {})
    variants = {SHIPPED: Variant(network)} | {
        form + which: Variant.fitted(network, form, load_bundle(path), options.steps)
        for which, path in bundles.items() for form in OTHER}
    rows, values = [], {}
    for label, variant in variants.items():
        found = variant.errors(unseen, options.samples)
        distance, density = (sum(column) / len(found) for column in zip(*found.values(), strict=True))
        cells = [f"{median:.1f}" for median, _ in found.values()]
        pairs = [(load_hand(hand), name) for hand in options.hands for name in resolve_objects(options.objects)]
        held = [variant.held(hand, name, options.num) for hand, name in pairs]
        rates = [rate(column) for column in torch.cat(held).T] if held else []
        rows.append([label, *cells, f"{distance:.1f}", f"{density:.2f}", *rates])
        values[label] = {"distances": found, "distance": distance, "log_density": density, "held": rates}
        print(rows[-1], file=sys.stderr)
    proposed = [f"{name} [%]" for name in PROTOCOLS] if options.hands else []
    emit(f"median distance to {options.samples} stored positions of each hand that was not trained on [mm]; log-density [nat]; "
         f"{len(options.hands) * len(options.objects) * options.num} proposals of other hands",
         rows, ["prior", *(name.removeprefix("assets/") for name in sorted(unseen.names)), "average", "log-density", *proposed],
         values, options.json)


if __name__ == "__main__":
    main()
