"""Errors of predicted distances, with z from the true grasp (posterior) and with z drawn as at inference (prior).

If both errors are equal, z carries no information; the smaller the posterior error is beside the prior error, the more z
carries. Only a bundle is needed, neither meshes nor a simulator.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from dro_grasp import distance_matrix
from dro_grasp.network.network import DistanceNetwork
from dro_grasp.train.config import AugmentationConfig
from dro_grasp.train.data.bundle.training_file import Bundle
from dro_grasp.train.losses import divergence
from dro_grasp.train.samples import SampleSource

SAMPLES = 400  # Placements of each hand
AT_ONCE = 50  # Placements that pass through the network together


@dataclass(frozen=True)
class DistanceError:
    """Distance error of one hand."""

    hand: str
    posterior: float  # mean absolute error of D(R,O) with z from the true grasp [m]
    prior: float  # the same with z drawn as at inference [m]
    divergence: float  # KL divergence of the posterior from the prior, a standard normal or a learned Gaussian [nat]


@torch.no_grad()
def distance_errors(network: DistanceNetwork, bundle: Bundle, samples: int = SAMPLES, seed: int = 0) -> list[DistanceError]:
    """Distance error of each hand of a bundle, with the open hand placed as close to the true grasp as in training.

    Args:
        network: Trained weights, in evaluation mode, on the CPU.
        bundle: Grasps to compare with; take the validate split, since training has seen the others.
        samples: Placements of each hand.
        seed: Seed of the samples.
    """
    source = SampleSource(bundle, network.config, AugmentationConfig())
    generator, posterior = (torch.Generator().manual_seed(seed) for _ in range(2))
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
