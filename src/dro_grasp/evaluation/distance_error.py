"""How far predicted distances are off, with z from the true grasp (posterior) and with z as it is drawn (prior).

Equal errors mean that z says nothing; a posterior error that is much the smaller one, that z says much. Needs a bundle alone,
no mesh and no simulator.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from dro_grasp import distance_matrix
from dro_grasp.datasets.bundle.training_file import Bundle
from dro_grasp.models.network import DistanceNetwork
from dro_grasp.training.config import AugmentationConfig
from dro_grasp.training.losses import divergence
from dro_grasp.training.samples import SampleSource

SAMPLES = 400
"""Placed hands, of each hand."""
AT_ONCE = 50
"""Of these go through the network together."""


@dataclass(frozen=True)
class DistanceError:
    """One hand's."""

    hand: str
    posterior: float
    """Mean absolute error of D(R,O) with z from the true grasp [m]."""
    prior: float
    """The same with z as it is drawn at inference [m]."""
    divergence: float
    """Of the posterior from the standard normal or the learned Gaussian [nat]."""


@torch.no_grad()
def distance_errors(network: DistanceNetwork, bundle: Bundle, samples: int = SAMPLES, seed: int = 0) -> list[DistanceError]:
    """Errors of each hand of a bundle, of which the open hand is placed as far off the true grasp as in training.

    Args:
        network: Trained weights, in evaluation mode, on the CPU.
        bundle: Grasps to compare with; of the validate split for numbers that mean something.
        samples: Placed hands, of each hand.
        seed: Of the samples.
    """
    source = SampleSource(bundle, network.config, AugmentationConfig())
    generator = torch.Generator().manual_seed(seed)
    found = []
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for name in source.names:
            parts, left = [], samples
            while left > 0:
                count = min(left, AT_ONCE)
                drawn = source.draw(name, count, generator)
                true = distance_matrix.build(drawn.grasp, drawn.obj)
                output = network(drawn.placed, drawn.obj, drawn.grasp)
                prior = network.predict(drawn.placed, drawn.obj, network.sample_latent(count, generator))
                nats = divergence(output.mean, output.log_variance, output.prior_mean, output.prior_log_variance).sum(-1)
                errors = [(d - true).abs().mean((1, 2)) for d in (output.distances, prior)]
                parts.append(torch.stack([*errors, nats]))
                left -= count
            found.append(DistanceError(name, *torch.cat(parts, 1).mean(1).tolist()))
    return found
