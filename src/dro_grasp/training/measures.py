"""How well a network has learned: errors of the distances that it predicts, and how well its hand encoder matches points.

Distances are predicted with z from the true grasp (posterior) and with z drawn as at inference (prior). If both errors are
equal, z carries no information; the smaller the posterior error is beside the prior error, the more z carries. Only a bundle
is needed, neither meshes nor a simulator.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor
from torch.nn import functional

from dro_grasp import distance_matrix
from dro_grasp.network.encoder import StaticGraphEncoder
from dro_grasp.network.network import DistanceNetwork
from dro_grasp.training.config import AugmentationConfig
from dro_grasp.training.data.bundle.training_file import Bundle
from dro_grasp.training.losses import divergence
from dro_grasp.training.samples import SampleSource

AT_ONCE = 50  # Placements that pass through the network together


@dataclass(frozen=True)
class DistanceError:
    """Distance error of one hand."""

    hand: str
    posterior: float  # mean absolute error of D(R,O) with z from the true grasp [m]
    prior: float  # the same with z drawn as at inference [m]
    divergence: float  # KL divergence of the posterior from the prior, a standard normal or a learned Gaussian [nat]


@torch.no_grad()
def distance_errors(network: DistanceNetwork, bundle: Bundle, samples: int = 400) -> list[DistanceError]:
    """Distance error of each hand of a bundle, over so many placements, each as close to the true grasp as in training.

    The network is in evaluation mode, on the CPU. Take the validate split of the grasps, since training has seen the others.
    """
    source = SampleSource(bundle, network.config, AugmentationConfig())
    generator, posterior = (torch.Generator().manual_seed(0) for _ in range(2))
    found = []
    for name in source.names:
        parts, left = [], samples
        while left > 0:
            count = min(left, AT_ONCE)
            drawn = source.draw(name, count, generator)
            true = distance_matrix.build(drawn.grasp, drawn.obj)
            output = network(drawn.placed, drawn.obj, drawn.grasp, posterior)
            prior = network.predict(drawn.placed, drawn.obj, network.sample_latent(count, generator))
            nats = divergence(output.mean, output.log_variance).sum(-1)
            errors = [(d - true).abs().mean((1, 2)) for d in (output.distances, prior)]
            parts.append(torch.stack([*errors, nats]))
            left -= count
        found.append(DistanceError(name, *torch.cat(parts, 1).mean(1).tolist()))
    return found


def matching_rank(
    encoder: StaticGraphEncoder, source: SampleSource, generator: torch.Generator, samples: int = 32
) -> dict[str, float]:
    """Mean rank of the true match of each point, by hand, over so many grasps.

    For each point of a grasping hand, the points of the open hand are ranked by cosine similarity of their features. Rank 1
    is perfect; half the number of points is chance. Source: paper section IV-D; the authors measure pretraining by it.
    """
    itself = torch.arange(source.network.n_hand)
    return {name: mean_rank(encoder, source, (name, name), itself, generator, samples) for name in source.names}


@torch.no_grad()
def mean_rank(
    encoder: StaticGraphEncoder, source: SampleSource, pair: tuple[str, str], matches: Int[Tensor, " n"],
    generator: torch.Generator, samples: int = 32,
) -> float:
    """Mean rank between the points of a hand in stored grasps and those of an open hand, a pair that may be one hand.

    `matches` are the true matches on the open hand of each point of the grasping hand.
    """
    (a, axes_a), (b, axes_b) = (
        (source.hands[name], source.network.axes(source.hands[name].palm_axes_wrist)) for name in pair)
    joints = source.grasps[pair[0]].joints
    chosen = torch.randint(len(joints), (samples,), generator=generator, device=generator.device)
    clouds = a.points(joints[chosen]) @ axes_a, b.points(b.random_open_joints(samples, generator)) @ axes_b
    first, second = (functional.normalize(encoder(c - c.mean(1, keepdim=True)), dim=-1) for c in clouds)
    similarity = first @ second.mT
    own = similarity.gather(2, matches.to(similarity.device).expand(samples, -1)[..., None])
    return float((similarity > own).sum(-1).float().mean() + 1)
