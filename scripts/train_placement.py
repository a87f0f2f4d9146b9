"""Train the placement prior of weights further, and nothing else: it shares no parameter with the rest, and wants more grasps.

    python scripts/train_placement.py --bundle BUNDLE --weights NAME|PATH --output PATH [--steps N]

A run takes minutes, so it does not resume. Needs no simulator.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from dro_grasp.datasets.bundle.training_file import load_bundle
from dro_grasp.files import check_output
from dro_grasp.models.checkpoints import history_of, load_weights, locate_weights, save_weights
from dro_grasp.models.network import DistanceNetwork
from dro_grasp.models.placement import Standardised
from dro_grasp.training.config import AugmentationConfig
from dro_grasp.training.losses import placement_loss
from dro_grasp.training.samples import SampleSource

HANDS, SAMPLES = 8, 12
"""Hands of a step, and grasps of each."""
BY_COUNT = 0.5
"""Hands are drawn in proportion to the number of their grasps to this power."""
WARMUP, DECAY = 200, 1e-3
"""Steps over which the learning rate grows, and weight decay."""
TOLD = 100
"""Steps between two reports."""


def train(network: DistanceNetwork, source: SampleSource, steps: int, rate: float, seed: int) -> dict[str, float]:
    """Train the prior of a network, which takes proportions; returns log-density [nat] and ROC area of the last reports."""
    prior = network.placement
    assert prior is not None
    standard = prior.standardised
    assert isinstance(standard, Standardised)
    prior.train().requires_grad_(True)
    optimiser = torch.optim.AdamW(prior.parameters(), lr=rate, weight_decay=DECAY)
    generator, sums = torch.Generator().manual_seed(seed), torch.zeros(2)
    reached: dict[str, float] = {}
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = rate * min(1.0, (step + 1) / WARMUP) * 0.5 * (1 + math.cos(math.pi * step / steps))
        parts = []
        for name in source.draw_hands(HANDS, generator, BY_COUNT):
            drawn = source.draw(name, SAMPLES, generator)
            hand = drawn.proportions.expand(SAMPLES, -1)
            noise = torch.randn(hand.shape, generator=generator)
            hand = hand + source.augmentation.proportions * standard.spread * noise
            density, score = prior.log_density(drawn.obj_hand, hand, drawn.position)
            parts.append((density, score, prior(drawn.obj_random, hand)[3]))
        density, score, other = map(torch.cat, zip(*parts, strict=True))
        optimiser.zero_grad()
        placement_loss(density, score, other).backward()
        optimiser.step()
        sums += torch.stack([density.mean(), (score[:, None] > other).float().mean()]).detach()
        if (step + 1) % TOLD == 0:
            reached = dict(zip(("log_density", "roc_area"), (sums / TOLD).tolist(), strict=True))
            print(f"step {step + 1} of {steps}: {reached}", file=sys.stderr)
            sums = torch.zeros(2)
    prior.eval()
    return reached


def main(argv: Sequence[str] | None = None) -> None:
    """Train and save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bundle", type=Path, required=True, help="training grasps")
    parser.add_argument("--weights", required=True, help="weights whose prior takes proportions (train --placement-hand)")
    parser.add_argument("--output", type=Path, required=True, help="weights to write")
    parser.add_argument("--steps", type=int, default=1300, help=f"steps of {HANDS * SAMPLES} grasps")
    parser.add_argument("--rate", type=float, default=1e-3, help="highest learning rate of AdamW")
    parser.add_argument("--partial", type=float, default=0.25, help="share of samples with half of the object cut away")
    parser.add_argument("--seed", type=int, default=7)
    options = parser.parse_args(argv)
    if options.steps < 1:
        parser.error(f"--steps is {options.steps}; give at least 1")
    check_output(options.output)
    torch.set_num_threads(1)
    network, bundle = load_weights(options.weights).eval(), load_bundle(options.bundle)
    if network.config.placement_hand != "proportions":
        parser.error(f"the placement prior of '{network.name}' takes features; train with --placement-hand proportions first")
    source = SampleSource(bundle, network.config, AugmentationConfig(partial=options.partial))
    reached = train(network, source, options.steps, options.rate, options.seed)
    settings: dict[str, Any] = {k: getattr(options, k) for k in ("steps", "rate", "partial", "seed")}
    settings |= {"samples": HANDS * SAMPLES, "by_count": BY_COUNT}
    about = {"stage": "placement", "data": bundle.summary(), "settings": settings, **reached}
    save_weights(network, options.output, about, history_of(locate_weights(options.weights)))


if __name__ == "__main__":
    main()
