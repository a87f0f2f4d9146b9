"""The placement prior: its loss in main training, and its training alone, since it shares no parameter with the rest."""

from __future__ import annotations

from pathlib import Path

import torch

from dro_grasp.datasets.bundle.training_file import Bundle
from dro_grasp.errors import TrainingError
from dro_grasp.models.network import DistanceNetwork, take_initial, untrained_network
from dro_grasp.models.placement import PlacementPrior
from dro_grasp.models.presets import NetworkConfig
from dro_grasp.training import losses
from dro_grasp.training.config import PlacementConfig
from dro_grasp.training.run_folder import run_plan
from dro_grasp.training.runs import Losses, Report, TrainingRun, begin, console_report
from dro_grasp.training.samples import HandSamples, SampleSource


def train_placement(
    bundle: Bundle, network: NetworkConfig, config: PlacementConfig, folder: Path, initial: DistanceNetwork,
    report: Report | None = None, name: str = "trained",
) -> DistanceNetwork:
    """Train the placement prior of given weights, and nothing else; arguments, result and errors as those of `train`.

    Raises:
        TrainingError: The network has no placement prior.
    """
    processes, device = begin(config.schedule)
    model = untrained_network(network, config.schedule.seed, name)
    take_initial(model, initial)
    model.to(device).eval()
    prior, generator = model.placement, torch.Generator(device)
    if prior is None:
        raise TrainingError(
            f"'{initial.name}' has no placement prior: in frame '{network.frame}' the network knows no placement")
    source = SampleSource(bundle, network, config.augmentation, device)
    plan = run_plan(config, bundle, network, initial=initial)
    run = TrainingRun(folder, prior, config.schedule, generator, processes, plan)

    def step() -> Losses:
        names = source.draw_hands(config.hands_per_step, generator, config.by_count)
        groups = [source.draw(hand, config.samples_per_hand, generator) for hand in names]
        return placement_losses(prior, groups, config.augmentation.proportions, generator)

    run.train(step, report or console_report("placement"))
    return model.cpu().eval()


def measure_hands(model: DistanceNetwork, source: SampleSource) -> None:
    """Let a placement prior know the proportions of the hands in training."""
    if model.placement is not None:
        model.placement.standardised.measure(torch.stack([source.proportions[name] for name in source.names]))


def placement_losses(
    prior: PlacementPrior, groups: list[HandSamples], noise: float, generator: torch.Generator
) -> Losses:
    """The prior's loss as `total`, and what it has learned, with `noise` on proportions, in their spreads.

    `log_density` is that of true positions [nat], `preferred` the share of pairs of a true and a random rotation in which the
    true one has the higher score.
    """
    rows = torch.cat([group.proportions.expand(len(group.placed), -1) for group in groups])
    hand = rows + noise * prior.standardised.spread * torch.randn(rows.shape, generator=generator, device=rows.device)
    obj, other, position = (torch.cat([getattr(g, n) for g in groups]) for n in ("obj_hand", "obj_random", "position"))
    density, score = prior.log_density(obj, hand, position)
    other_score = prior(other, hand)[3]
    preferred = (score[:, None] > other_score).float().mean()
    return {"total": losses.placement_loss(density, score, other_score), "log_density": density.mean(), "preferred": preferred}
