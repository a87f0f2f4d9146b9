"""What the prior of z should know: one pooled vector of hand and object, or a token of each link.

    python benchmarks/conditions.py --bundle BUNDLE --validation BUNDLE [--unseen BUNDLE] [--weights NAME|PATH] [--steps N]
        [--hands HAND ...] [--objects NAME ...] [--num N] [--json]

Trains condition and flow of a network anew in both forms, and nothing else: encoders and motion stay. The flow's loss on
grasps that were not trained on says how much of z each form explains; then the network alone proposes grasps with it, which
are tried.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from placements import PROTOCOLS, rate
from report import emit
from torch import Tensor, nn
from torch.nn import functional

from dro_grasp.compare.stages import pair_seed
from dro_grasp.datasets.bundle.training_file import load_bundle
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.models.checkpoints import load_weights
from dro_grasp.models.encoder import SLOPE
from dro_grasp.models.latent import Condition, FlowPrior
from dro_grasp.models.network import DistanceNetwork
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.network import propose
from dro_grasp.predict.stages import complete
from dro_grasp.simulation.trial import simulate
from dro_grasp.training.config import AugmentationConfig
from dro_grasp.training.samples import HandSamples, SampleSource

HANDS, SAMPLES = 4, 16
"""Hands of a step, and grasps of each."""
RATE, WARMUP = 1e-3, 200
"""Highest learning rate of Adam, and the steps over which it grows."""
NEAR = 0.02
"""Width of the window through which a link sees the object [m]."""


class LinkCondition(nn.Module):
    """A token of each link: its mean feature, where it is, and the object's features near it; the pooled vector is one more.

    `hand` says which point is of which link; it is set before each pass.
    """

    def __init__(self, features: int, width: int) -> None:
        super().__init__()
        self.whole = Condition(features, width)
        self.link = nn.Sequential(
            nn.Linear(2 * features + 7, width), nn.LeakyReLU(SLOPE), nn.Linear(width, width), nn.LeakyReLU(SLOPE),
            nn.Linear(width, width))
        self.hand: Hand | None = None

    def forward(self, hand_features: Tensor, obj_features: Tensor, hand: Tensor, obj: Tensor) -> Tensor:
        """Tokens end to end, (b, tokens * width), so that they pass where one vector does."""
        assert self.hand is not None
        member = functional.one_hot(self.hand.link_index).float()
        member = member[:, member.sum(0) > 0]
        mean = (member / member.sum(0)).T
        features, place = mean @ hand_features, mean @ hand
        to_object = obj[:, None] - place[:, :, None]
        distance = to_object.norm(dim=-1)
        window = (-distance / NEAR).softmax(-1)
        near, toward = window @ obj_features, (window[..., None] * to_object).sum(2)
        scaled = torch.cat([place - hand.mean(1, keepdim=True), toward, distance.amin(-1, keepdim=True)], -1) / Condition.SCALE
        tokens = self.link(torch.cat([features, near, scaled], -1))
        whole = self.whole(hand_features, obj_features, hand, obj)[:, None]
        return torch.cat([whole, tokens], 1).flatten(1)


class LinkFlow(FlowPrior):
    """The flow, whose layers look at the tokens."""

    HEADS = 4

    def __init__(self, latent: int, width: int) -> None:
        super().__init__(latent, width)
        self.width = width
        self.looks = nn.ModuleList(nn.MultiheadAttention(width, self.HEADS, batch_first=True) for _ in self.layers)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in self.layers)

    def velocity(self, z: Tensor, time: Tensor, condition: Tensor) -> Tensor:
        """As the flow's."""
        tokens = condition.unflatten(1, (-1, self.width))
        angle = 0.5 * torch.pi * time
        x = self.enter(torch.cat([z, angle.sin(), angle.cos()], -1)) + tokens[:, 0]
        for layer, look, norm in zip(self.layers, self.looks, self.norms, strict=True):
            x = x + look(norm(x)[:, None], tokens, tokens, need_weights=False)[0][:, 0]
            x = x + layer(x)
        return self.leave(x)


FORMS: dict[str, tuple[type[nn.Module], type[FlowPrior]]] = {
    "pooled vector": (Condition, FlowPrior), "tokens of links": (LinkCondition, LinkFlow)}
"""Condition and flow of each row."""


def flow_loss(network: DistanceNetwork, group: HandSamples, generator: torch.Generator) -> Tensor:
    """The flow's loss of each grasp of one hand; encoders and motion are not trained."""
    condition, prior, motion = network.condition, network.prior, network.motion
    assert condition is not None
    assert motion is not None
    assert isinstance(prior, FlowPrior)
    with torch.no_grad():
        phi_hand, phi_object = network.encode(group.placed, group.obj)
        z, _ = motion.encode(phi_hand, group.placed, group.grasp)
    know(network, group.hand)
    return prior.loss(z, condition(phi_hand, phi_object, group.placed, group.obj), generator)


def know(network: DistanceNetwork, hand: Hand) -> None:
    """Tell a condition that takes links which hand comes next."""
    if isinstance(network.condition, LinkCondition):
        network.condition.hand = hand.with_points(network.config.n_hand)


def fit(network: DistanceNetwork, form: str, source: SampleSource, steps: int) -> DistanceNetwork:
    """The network with condition and flow of a form, trained on a bundle."""
    condition, flow = FORMS[form]
    width = network.config.latent_head[0]
    torch.manual_seed(0)
    trained = nn.ModuleList([condition(network.config.width, width), flow(network.config.latent, width)]).train()
    network.condition, network.prior = trained  # type: ignore[assignment]
    optimiser = torch.optim.Adam(trained.parameters(), lr=RATE)
    generator, told = torch.Generator().manual_seed(0), 0.0
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = RATE * min(1.0, (step + 1) / WARMUP) * 0.5 * (1 + math.cos(math.pi * step / steps))
        parts = [flow_loss(network, source.draw(name, SAMPLES, generator), generator)
                 for name in source.draw_hands(HANDS, generator, 0.5)]
        loss = torch.cat(parts).mean()
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(trained.parameters(), 1.0)
        optimiser.step()
        told += float(loss.detach())
        if (step + 1) % 200 == 0:
            print(f"{form}: step {step + 1} of {steps}, {told / 200:.4f}", file=sys.stderr)
            told = 0.0
    trained.eval()
    return network


@torch.no_grad()
def loss_of(network: DistanceNetwork, source: SampleSource, count: int) -> dict[str, float]:
    """The flow's loss on grasps of each hand of a bundle."""
    generator = torch.Generator().manual_seed(5)
    return {name: float(flow_loss(network, source.draw(name, count, generator), generator).mean()) for name in source.names}


@torch.no_grad()
def held(network: DistanceNetwork, hand: Hand, name: str, num: int) -> tuple[Tensor, float]:
    """Outcomes of proposals for an object, a column for each protocol, and the processor time of a proposal [s]."""
    obj = load_object(name)
    problem = GraspProblem(hand, obj)
    know(network, hand)
    began = time.process_time()
    grasps = propose(problem, network, num, torch.Generator().manual_seed(pair_seed(0, hand, obj))).grasps
    seconds = (time.process_time() - began) / num
    grasps = complete(problem, grasps)
    return torch.stack([simulate(hand, obj, grasps, protocol).success for protocol in PROTOCOLS], 1), seconds


def main(argv: Sequence[str] | None = None) -> None:
    """Train, compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bundle", required=True, type=Path, help="training grasps")
    parser.add_argument("--validation", required=True, type=Path, help="grasps on objects that were not trained on")
    parser.add_argument("--unseen", type=Path, help="grasps of hands that were not trained on")
    parser.add_argument("--weights", help="network whose encoders and motion are taken; the default weights")
    parser.add_argument("--steps", type=int, default=3000, help=f"steps of {HANDS * SAMPLES} grasps")
    parser.add_argument("--samples", type=int, default=400, help="stored grasps of each hand that the loss is measured on")
    parser.add_argument("--hands", nargs="+", default=[], help="hands to propose grasps for")
    parser.add_argument("--objects", nargs="+", default=["jar", "rod", "vase", "brick", "egg", "cone"], help="their objects")
    parser.add_argument("--num", type=int, default=12, help="grasps of each of these pairs")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    rows, values = [], {}
    for form in FORMS:
        network = load_weights(options.weights).eval()
        source, validation, *unseen = (
            SampleSource(load_bundle(path), network.config, AugmentationConfig())
            for path in (options.bundle, options.validation, options.unseen) if path is not None)
        fit(network, form, source, options.steps)
        losses = [loss_of(network, part, options.samples) for part in (validation, *unseen)]
        pairs = [(load_hand(hand), name) for hand in options.hands for name in resolve_objects(options.objects)]
        tried = [held(network, hand, name, options.num) for hand, name in pairs]
        rates = [rate(column) for column in torch.cat([outcome for outcome, _ in tried]).T] if tried else []
        cost = [f"{1e3 * sum(seconds for _, seconds in tried) / len(tried):.0f}"] if tried else []
        rows.append([form, *(f"{sum(part.values()) / len(part):.4f}" for part in losses), *rates, *cost])
        values[form] = {"losses": losses, "held": rates, "ms": cost}
        print(rows[-1], file=sys.stderr)
    proposed = [*(f"{name} [%]" for name in PROTOCOLS), "processor time [ms]"] if options.hands else []
    emit(f"loss of the flow on {options.samples} grasps of each hand; "
         f"{len(options.hands) * len(options.objects) * options.num} proposals",
         rows, ["condition", "validate", *(["unseen hands"] if options.unseen is not None else []), *proposed], values,
         options.json)


if __name__ == "__main__":
    main()
