"""What GenDexGrasp's and ManiFM's networks share: layers that treat all points alike, the divergence of z, and training."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dro_grasp.kinds import Checked
from dro_grasp.training.config import ScheduleConfig
from dro_grasp.training.data.bundle.training_file import Bundle
from dro_grasp.training.runs import Losses, Report, TrainingRun, begin, recalibrate, run_plan
from lab.methods.bundle_draws import BundleDraws

Network = TypeVar("Network", bound=nn.Module)
Config = TypeVar("Config", bound="AutoencoderConfig")
Passed = TypeVar("Passed")
"""Samples and what the network made of them."""


@dataclass(frozen=True)
class AutoencoderConfig(Checked):
    """Settings of both."""

    schedule: ScheduleConfig = field(default_factory=lambda: ScheduleConfig(steps=10_000))
    """Differs from both: 1e-3 and a cosine instead of 1e-4, better at equal time on a CPU."""
    points: int = 256
    """Object points (both: 2,048; fewer give more steps in an hour of a CPU)."""
    hand_points: int = 256
    """Points of a hand that touch them (ours)."""


def layer(inputs: int, outputs: int) -> tuple[nn.Module, ...]:
    """A linear layer, BatchNorm and ReLU."""
    return nn.Linear(inputs, outputs), nn.BatchNorm1d(outputs), nn.ReLU()


def each(layers: nn.Module, values: Float[Tensor, "b m c"]) -> Float[Tensor, "b m d"]:
    """Layers applied to every point alike; BatchNorm counts points of all objects."""
    return layers(values.flatten(0, 1)).unflatten(0, values.shape[:2])


def divergence(mean: Float[Tensor, "b latent"], log_variance: Float[Tensor, "b latent"]) -> Float[Tensor, ""]:
    """Mean divergence of z from N(0, I) [nat]."""
    return 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(-1).mean()


def train_autoencoder(
    made: Callable[[], Network], bundle: Bundle, config: Config, folder: Path,
    forward: Callable[[Network, BundleDraws, Config, torch.Generator], Passed],
    losses: Callable[[Passed, Config, float], Losses], report: Report,
) -> Network:
    """Train a network on a bundle; a checkpoint in the folder is resumed.

    Args:
        made: Makes the network.
        bundle: Training grasps.
        config: Settings.
        folder: Of the run.
        forward: Draws a batch and passes it through the network.
        losses: Of what `forward` returned; told the share of the schedule that is done.
        report: Told of the losses.

    Returns:
        The moving average of the weights, on the CPU, in evaluation mode.

    Raises:
        BundleError: The bundle holds no grasps.
        OptionError: The schedule cannot be carried out here.
        TrainingError: A loss is not finite.
    """
    processes, device = begin(config.schedule)
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(config.schedule.seed)
        model = made().to(device)
    generator, draws = torch.Generator(device), BundleDraws(bundle, config.hand_points, device)
    run = TrainingRun(folder, model, config.schedule, generator, processes, run_plan(config, bundle))
    model.train()
    run.train(lambda: losses(forward(model, draws, config, generator), config, run.progress), report)
    run.seed_shard()
    recalibrate(model, lambda: forward(model, draws, config, generator), config.schedule.recalibration)
    return model.cpu().eval()
