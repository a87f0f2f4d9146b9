"""Where a placement prior puts hands that it has never seen: by features that a network learned, or by the hand's proportions.

    python benchmarks/placements.py --bundle real.safetensors --more procedural.safetensors --held-out unseen.safetensors
        [--hands HAND ...] [--objects NAME ...] [--json]

Trains the placement prior of the shipped network anew, nothing else, and compares its likeliest positions with those of stored
grasps: of hands that it was not trained on (`dataset bundle --split few_shot`). With `--hands`, the network alone, with each of
these priors, proposes grasps of these hands, which are tried.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import torch
from report import emit
from torch import Tensor

from dro_grasp.datasets.bundle.training_file import load_bundle
from dro_grasp.evaluation.metrics import wilson_interval
from dro_grasp.evaluation.success_rates import pair_seed
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.hands.proportions import proportions
from dro_grasp.models.checkpoints import load_weights
from dro_grasp.models.network import DistanceNetwork
from dro_grasp.models.placement import PlacementPrior, Standardised
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.pipeline.problem import GraspProblem
from dro_grasp.pipeline.proposal import propose
from dro_grasp.pipeline.stages import complete
from dro_grasp.simulation.trial import simulate
from dro_grasp.training.config import AugmentationConfig
from dro_grasp.training.losses import placement_loss
from dro_grasp.training.samples import SampleSource

HANDS, SAMPLES = 4, 16
"""Hands of a step, and grasps of each."""
MORE = 0.6
"""Share of the steps that take the hands of --more."""
RATE = 2e-3
"""Highest learning rate of AdamW, on a cycle."""
PROTOCOLS = ("dro", "strict")
"""Trials of proposed grasps."""
SHIPPED = "features, as shipped"
"""The row of the shipped prior."""


class Variant:
    """A network with another placement prior, and what that knows of a hand."""

    def __init__(self, network: DistanceNetwork, prior: PlacementPrior) -> None:
        self.network, self.prior = network, prior

    @torch.no_grad()
    def describe(self, hand: Hand) -> Tensor:
        """What the prior is told of a hand."""
        axes = self.network.config.axes(hand.palm_axes_wrist)
        if isinstance(self.prior.standardised, Standardised):
            return proportions(hand, axes)
        opened = hand.points(hand.canonical_joints()) @ axes
        return self.network.hand_encoder((opened - opened.mean(0))[None]).mean(1)[0]

    def fit(self, sources: list[SampleSource], steps: int, noise: float) -> Variant:
        """Train it on one bundle, or on two in turn."""
        told = {name: self.describe(source.hands[name]) for source in sources for name in source.names}
        standard = self.prior.standardised
        if isinstance(standard, Standardised):
            standard.measure(torch.stack([*told.values()]))
        optimiser = torch.optim.AdamW(self.prior.parameters(), weight_decay=1e-3)
        rate = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps)
        generator = torch.Generator().manual_seed(0)
        for step in range(steps):
            source = sources[-1 if torch.rand((), generator=generator) < MORE else 0]
            parts = []
            for name in source.draw_hands(HANDS, generator):
                group = source.draw(name, SAMPLES, generator)
                hand = told[name].expand(SAMPLES, -1)
                if isinstance(standard, Standardised):
                    hand = hand + noise * standard.spread * torch.randn(hand.shape, generator=generator)
                density, score = self.prior.log_density(group.obj_hand, hand, group.position)
                parts.append(placement_loss(density, score, self.prior(group.obj_random, hand)[3]))
            optimiser.zero_grad()
            torch.stack(parts).mean().backward()
            optimiser.step()
            rate.step()
            if step % 500 == 0:
                print(f"step {step} of {steps}", file=sys.stderr)
        self.prior.eval()
        return self

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
        network, obj, known = load_weights(None).eval(), load_object(name), isinstance(self.prior.standardised, Standardised)
        network.placement = self.prior
        network.config = replace(network.config, placement_hand="proportions" if known else "features")
        problem = GraspProblem(hand, obj)
        grasps = propose(problem, network, num, torch.Generator().manual_seed(pair_seed(0, hand, obj))).grasps
        grasps = complete(problem, grasps)
        return torch.stack([simulate(hand, obj, grasps, protocol).success for protocol in PROTOCOLS], 1)


def main() -> None:
    """Train, compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bundle", required=True, type=Path, help="grasps of the hands in training")
    parser.add_argument("--more", type=Path, help="grasps of further hands, for a row of its own")
    parser.add_argument("--held-out", required=True, type=Path, help="grasps of hands that were not trained on")
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--samples", type=int, default=300, help="stored grasps of each hand")
    parser.add_argument("--hands", nargs="+", default=[], help="hands to propose grasps for")
    parser.add_argument("--objects", nargs="+", default=["jar", "rod", "vase", "brick", "egg", "cone"], help="their objects")
    parser.add_argument("--num", type=int, default=8, help="grasps of each of these pairs")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    network, noise = load_weights(None).eval(), AugmentationConfig().proportions
    config = network.config

    def source(path: Path) -> SampleSource:
        return SampleSource(load_bundle(path), config, AugmentationConfig())

    def fresh(features: int | None) -> Variant:
        return Variant(network, PlacementPrior(features, config.placement_width, config.placement_components))

    bundle, unseen = source(options.bundle), source(options.held_out)
    shipped = network.placement
    assert shipped is not None
    variants = {SHIPPED: Variant(network, shipped), "proportions": fresh(None).fit([bundle], options.steps, noise)}
    if options.more is not None:
        both = [bundle, source(options.more)]
        variants |= {"features, more hands": fresh(config.width).fit(both, options.steps, noise),
                   "proportions, more hands": fresh(None).fit(both, options.steps, noise)}
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


def rate(held: Tensor) -> str:
    """Success in per cent with its 95 % interval."""
    low, high = wilson_interval(int(held.sum()), len(held))
    return f"{100 * float(held.float().mean()):.1f} [{100 * low:.0f}-{100 * high:.0f}]"


if __name__ == "__main__":
    main()
