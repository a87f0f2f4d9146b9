"""Training of contact maps from a bundle: any hand's grasps, one map each. Source: GenDexGrasp; differences are noted."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.baselines.gendexgrasp.contact_maps import TRAINING_GAMMA, contact_map
from dro_grasp.baselines.gendexgrasp.map_network import LATENT, ContactMapNetwork, MapOutput
from dro_grasp.datasets.bundle.training_file import Bundle
from dro_grasp.errors import BundleError
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


class MapSource:
    """Draws maps of a bundle's grasps, all hands alike."""

    def __init__(self, bundle: Bundle, config: MapTrainingConfig, device: torch.device | str = "cpu") -> None:
        """Put hands, grasps and objects on the device of the generators that draw from them.

        Raises:
            BundleError: The bundle holds no grasps.
        """
        self.config = config
        names = [name for name, grasps in bundle.grasps.items() if len(grasps.joints)]
        if not names:
            raise BundleError("the bundle holds no grasps; synthesise some first")
        self.hands = [bundle.hands[n].with_points(min(config.hand_points, bundle.hands[n].n_points)).to(device) for n in names]
        self.grasps = [bundle.grasps[n].to(device) for n in names]
        self.points = torch.stack([cloud.points for cloud in bundle.objects.values()]).to(device)
        self.normals = torch.stack([cloud.normals for cloud in bundle.objects.values()]).to(device)
        self.centres = self.points.mean(1)

    def draw(self, generator: torch.Generator) -> MapSamples:
        """One step's maps, of one or two hands."""
        config, device = self.config, generator.device
        parts = []
        for hand_index in torch.randint(len(self.hands), (2,), generator=generator, device=device).tolist():
            hand, grasps = self.hands[hand_index], self.grasps[hand_index]
            count = config.batch // 2
            chosen = torch.randint(len(grasps.joints), (count,), generator=generator, device=device)
            picks = torch.randint(self.points.shape[1], (count, config.points), generator=generator, device=device)
            of = grasps.object_index[chosen]
            points, normals = self.points[of[:, None], picks], self.normals[of[:, None], picks]
            noise = config.noise * torch.randn(points.shape, generator=generator, device=device)
            touched = hand.points(grasps.joints[chosen], grasps.T_object_wrist[chosen])
            parts.append((points + noise - self.centres[of][:, None], contact_map(points, normals, touched, TRAINING_GAMMA)))
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
    generator, source = torch.Generator(device), MapSource(bundle, config, device)
    run = TrainingRun(folder, model, config.schedule, generator, processes)
    model.train()

    def forward() -> tuple[MapSamples, MapOutput]:
        drawn = source.draw(generator)
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
