"""How well weights know hands by their kinematics alone: which point is which, and how the hand moves.

    python -m lab.benchmarks.motions --weights NAME|PATH ... [--bundle BUNDLE] [--hands HAND ...] [--json]

For any joint values within the limits: the mean rank of each point of the posed hand among those of the open hand, as after
pretraining (1 is perfect), and the distance by which z, encoded from both poses and decoded, misses the posed hand. A bundle
adds its hands.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch

from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.network.checkpoints import load_weights
from dro_grasp.network.network import DistanceNetwork
from dro_grasp.training.config import AugmentationConfig
from dro_grasp.training.data.bundle.training_file import Bundle, HandGrasps, ObjectCloud, load_bundle
from dro_grasp.training.measures import mean_rank
from dro_grasp.training.samples import SampleSource
from lab.benchmarks.report import emit

POSES = 64
"""Poses of each hand."""


def any_pose(hand: Hand) -> HandGrasps:
    """Joint values within the limits, without objects."""
    generator = torch.Generator().manual_seed(3)
    joints, wrists = hand.random_joints(POSES, generator), torch.eye(4).repeat(POSES, 1, 1)
    return HandGrasps(wrists, joints, torch.zeros(POSES, dtype=torch.long))


@torch.no_grad()
def measured(network: DistanceNetwork, source: SampleSource, name: str) -> tuple[float, float]:
    """Mean rank, and mean distance of moved points from the posed hand's [mm]."""
    generator = torch.Generator().manual_seed(4)
    rank = mean_rank(network.hand_encoder, source, (name, name), torch.arange(network.config.n_hand), generator, POSES)
    motion = network.motion
    if motion is None:
        return rank, float("nan")
    hand, goal = source.draw_motions(name, POSES, generator)
    features = network.hand_encoder(hand - hand.mean(1, keepdim=True))
    z, _ = motion.encode(features, hand, goal)
    return rank, 1e3 * float((motion(features, hand, z[:, None])[:, 0] - goal).norm(dim=-1).mean())


def main(argv: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", nargs="+", required=True, help="weights to compare")
    parser.add_argument("--bundle", type=Path, help="its hands are measured too")
    parser.add_argument("--hands", nargs="*", default=[], help="further hands")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    hands = {} if options.bundle is None else dict(load_bundle(options.bundle).hands)
    hands |= {name: load_hand(name) for name in options.hands}
    if not hands:
        parser.error("no hand is given; name some with --hands, or a --bundle that holds some")
    nothing = {"nothing": ObjectCloud(torch.zeros(1, 3), torch.zeros(1, 3))}
    poses = Bundle({h.name: h for h in hands.values()}, nothing, {h.name: any_pose(h) for h in hands.values()})
    rows, values = [], {}
    for weights in options.weights:
        network = load_weights(weights).eval()
        source = SampleSource(poses, network.config, AugmentationConfig())
        found = {name: measured(network, source, name) for name in source.names}
        average = [sum(column) / len(found) for column in zip(*found.values(), strict=True)]
        rows += [[weights, name, f"{rank:.1f}", f"{miss:.1f}"] for name, (rank, miss) in [*found.items(), ("average", average)]]
        values[weights] = found
    emit(f"{POSES} poses of each hand", rows, ["weights", "hand", "rank", "missed [mm]"], values, options.json)


if __name__ == "__main__":
    main()
