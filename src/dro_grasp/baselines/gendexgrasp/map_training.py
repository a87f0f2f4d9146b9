"""Training of contact maps from a bundle: any hand's grasps, one map each. Source: GenDexGrasp; differences are noted."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.baselines.bundle_draws import BundleDraws
from dro_grasp.baselines.gendexgrasp.contact_maps import TRAINING_GAMMA, contact_map
from dro_grasp.baselines.gendexgrasp.map_network import LATENT, ContactMapNetwork, MapOutput
from dro_grasp.datasets.bundle.training_file import Bundle
from dro_grasp.training.config import ScheduleConfig
from dro_grasp.training.reports import Report, console_report
from dro_grasp.training.runs import Losses, TrainingRun, begin, recalibrate


@dataclass(frozen=True)
class MapTrainingConfig:
    """Settings; the numbers are GenDexGrasp's, unless stated otherwise."""

    schedule: ScheduleConfig = field(default_factory=lambda: ScheduleConfig(steps=3_000))
    """Differs from GenDexGrasp: 1e-3 and a cosine instead of 1e-4, better at equal time on a CPU."""
    batch: int = 32
    """Maps in a step (GenDexGrasp: 128; fewer give more steps in an hour of a CPU)."""
    points: int = 256
    """Object points of a map (GenDexGrasp: 2,048, likewise)."""
    hand_points: int = 256
    """Points of a hand that make a map."""
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


@dataclass(frozen=True)
class MapSamples:
    """Objects with true contact maps."""

    points: Float[Tensor, "b m 3"]
    """About the object's centre, with noise [m]."""
    contact: Float[Tensor, "b m"]


def draw_maps(draws: BundleDraws, config: MapTrainingConfig, generator: torch.Generator) -> MapSamples:
    """One step's maps, of one or two hands."""
    parts = []
    for _ in range(2):
        drawn = draws.draw(config.batch // 2, config.points, generator)
        noise = config.noise * torch.randn(drawn.points.shape, generator=generator, device=generator.device)
        parts.append((drawn.points + noise, contact_map(drawn.points, drawn.normals, drawn.body, TRAINING_GAMMA)))
    points, contact = (torch.cat(part) for part in zip(*parts, strict=True))
    return MapSamples(points, contact)


def train_contact_maps(
    bundle: Bundle, config: MapTrainingConfig, folder: Path, report: Report | None = None
) -> ContactMapNetwork:
    """Train on a bundle; a checkpoint in the folder is resumed.

    Returns:
        The moving average of the weights, on the CPU, in evaluation mode.

    Raises:
        BundleError: The bundle holds no grasps.
        OptionError: The schedule cannot be carried out here.
        TrainingError: A loss is not finite.
    """
    processes, device = begin(config.schedule)
    torch.manual_seed(config.schedule.seed)
    model = ContactMapNetwork().to(device)
    generator, draws = torch.Generator(device), BundleDraws(bundle, config.hand_points, device)
    run = TrainingRun(folder, model, config.schedule, generator, processes)
    model.train()

    def forward() -> tuple[MapSamples, MapOutput]:
        drawn = draw_maps(draws, config, generator)
        noise = torch.randn(len(drawn.points), LATENT, generator=generator, device=device)
        return drawn, model(drawn.points, drawn.contact, noise)

    run.train(lambda: map_losses(*forward(), config, run.progress), report or console_report("contact maps"))
    model.load_state_dict(run.average.module.state_dict())
    run.seed_shard()
    recalibrate(model, forward, config.schedule.recalibration)
    return model.cpu().eval()


def map_losses(samples: MapSamples, output: MapOutput, config: MapTrainingConfig, progress: float) -> Losses:
    """Losses of one batch; `progress` is the share of the schedule that is done."""
    weight = (config.emphasis * samples.contact).exp()
    error = (weight * (output.contact - samples.contact).square()).mean(-1).sqrt().mean()
    mean, log_variance = output.mean, output.log_variance
    nats = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(-1).mean()
    divergence = config.divergence * config.divergence_growth**progress * nats
    return {"total": config.reconstruction * error + divergence, "error": error, "nats": nats}
