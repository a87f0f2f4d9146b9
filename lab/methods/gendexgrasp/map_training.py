"""Training of contact maps from a bundle: any hand's grasps, one map each. Source: GenDexGrasp; differences are noted."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.training.data.bundle.training_file import Bundle
from dro_grasp.training.runs import Losses, Report, console_report
from lab.methods.bundle_draws import BundleDraws
from lab.methods.gendexgrasp.contact_maps import TRAINING_GAMMA, contact_map
from lab.methods.gendexgrasp.map_network import LATENT, ContactMapNetwork, MapOutput
from lab.methods.point_autoencoder import AutoencoderConfig, divergence, train_autoencoder


@dataclass(frozen=True)
class MapTrainingConfig(AutoencoderConfig):
    """Settings; the numbers are GenDexGrasp's, unless stated otherwise."""

    batch: int = 32
    """Maps in a step (GenDexGrasp: 128; fewer give more steps in an hour of a CPU)."""
    noise: float = 0.001
    """Standard deviation of the noise on object points [m]."""
    reconstruction: float = 1000.0
    """Weight of the root of the mean squared error."""
    emphasis: float = 3.0
    """A point of contact c counts exp(emphasis c) times."""
    divergence: float = 0.05
    """Weight of the divergence of z from N(0, I) at the start [1/nat]."""
    divergence_growth: float = 1.5**9
    """Factor by which it grows until the end: 1.5 every two epochs, 18 epochs."""


def draw_maps(
    draws: BundleDraws, config: MapTrainingConfig, generator: torch.Generator
) -> tuple[Float[Tensor, "b m 3"], Float[Tensor, "b m"]]:
    """One step's objects, about their centres and with noise [m], and their true maps, of one or two hands."""
    parts = []
    for _ in range(2):
        drawn = draws.draw(config.batch // 2, config.points, generator)
        noise = config.noise * torch.randn(drawn.points.shape, generator=generator, device=generator.device)
        parts.append((drawn.points + noise, contact_map(drawn.points, drawn.normals, drawn.body, TRAINING_GAMMA)))
    points, contact = (torch.cat(part) for part in zip(*parts, strict=True))
    return points, contact


def train_contact_maps(
    bundle: Bundle, config: MapTrainingConfig, folder: Path, report: Report | None = None
) -> ContactMapNetwork:
    """See `train_autoencoder`."""
    return train_autoencoder(
        ContactMapNetwork, bundle, config, folder, _forward, map_losses, report or console_report("contact maps"))


def _forward(
    model: ContactMapNetwork, draws: BundleDraws, config: MapTrainingConfig, generator: torch.Generator
) -> tuple[Float[Tensor, "b m"], MapOutput]:
    """True maps of a batch, and the network's."""
    points, contact = draw_maps(draws, config, generator)
    return contact, model(points, contact, torch.randn(len(points), LATENT, generator=generator, device=generator.device))


def map_losses(passed: tuple[Float[Tensor, "b m"], MapOutput], config: MapTrainingConfig, progress: float) -> Losses:
    """Losses of one batch; `progress` is the share of the schedule that is done."""
    true, output = passed
    error = ((config.emphasis * true).exp() * (output.contact - true).square()).mean(-1).sqrt().mean()
    nats = divergence(output.mean, output.log_variance)
    weight = config.divergence * config.divergence_growth**progress
    return {"total": config.reconstruction * error + weight * nats, "error": error, "nats": nats}
