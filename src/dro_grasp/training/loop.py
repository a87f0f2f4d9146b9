"""Main training of the D(R,O) network, and of its placement prior alone, which shares no parameter with the rest.

Source: paper section III-E; the prior is ours.
"""

from __future__ import annotations

from pathlib import Path

import torch

from dro_grasp import distance_matrix
from dro_grasp.errors import TrainingError
from dro_grasp.geometry.se3 import apply
from dro_grasp.network.network import DistanceNetwork, take_initial, take_pretrained, untrained_network
from dro_grasp.network.placement import PlacementPrior
from dro_grasp.network.presets import NetworkConfig
from dro_grasp.training import losses
from dro_grasp.training.config import PlacementConfig, TrainConfig
from dro_grasp.training.data.bundle.training_file import Bundle
from dro_grasp.training.runs import Losses, Report, TrainingRun, begin, console_report, recalibrate, run_plan
from dro_grasp.training.samples import Batch, SampleSource


def train(
    bundle: Bundle, network: NetworkConfig, config: TrainConfig, folder: Path, pretrained: DistanceNetwork | None = None,
    report: Report | None = None, name: str = "trained", initial: DistanceNetwork | None = None,
) -> DistanceNetwork:
    """Train on a bundle.

    Args:
        bundle: Hands, objects and grasps.
        network: Form and sizes of the network.
        config: Schedule, losses and samples.
        folder: Run folder; a checkpoint in it is resumed and reproduces the curve.
        pretrained: Source of the hand encoder, and of the motion where z moves the hand. Without it, and without
            `initial`, the hand encoder is trained too.
        report: Called every few steps; the console by default.
        name: Name of the trained network.
        initial: Weights to begin with, as in fine-tuning; `network` must be their configuration.

    Returns:
        The moving average of the weights, on the CPU, in evaluation mode.

    Raises:
        OptionError: The schedule cannot be carried out here.
        TrainingError: A loss is not finite.
        WeightsError: `initial` or `pretrained` does not fit the network.
    """
    processes, device = begin(config.schedule)
    model = untrained_network(network, config.schedule.seed, name)
    if initial is not None:
        take_initial(model, initial)
    if pretrained is not None:
        take_pretrained(model, pretrained)
    frozen = (pretrained is not None or initial is not None) and config.freeze_hand_encoder
    model.to(device).hand_encoder.requires_grad_(not frozen)
    model.mixed = config.schedule.mixed
    generator = torch.Generator(device)
    source = SampleSource(bundle, network, config.augmentation, device)
    if initial is None:
        measure_hands(model, source)
    plan = run_plan(config, bundle, network, initial=initial, pretrained=pretrained)
    run = TrainingRun(folder, model, config.schedule, generator, processes, plan)
    model.train()
    if frozen:
        # train() would put the frozen encoder's BatchNorm back into training mode.
        model.hand_encoder.eval()

    def draw(generator: torch.Generator) -> Batch:
        return source.draw_batch(config.hands_per_step, config.samples_per_hand, config.by_count, config.columns, generator)

    def forward() -> None:
        batch = draw(generator)
        model(batch.placed, batch.obj, batch.grasp, generator, columns=1)

    run.train(lambda batch: step_losses(model, batch, config, generator), report or console_report("training"), draw)
    run.seed_shard()
    recalibrate(model, forward, config.schedule.recalibration)
    model.mixed = False
    return model.cpu().eval()


def step_losses(
    model: DistanceNetwork, batch: Batch, config: TrainConfig, generator: torch.Generator
) -> Losses:
    """All losses of one batch, by name, with their weighted sum as `total`, and the plain divergence as `nats`."""
    output = model(batch.placed, batch.obj, batch.grasp, generator, columns=config.columns)
    anchors = batch.obj[:, : config.columns]
    parts = {"distance": losses.distance_loss(output.distances, distance_matrix.build(batch.grasp, anchors))}
    T, _, _ = distance_matrix.decode_segments(batch.segments, output.distances, anchors, among=batch.thin)
    parts["pose"] = losses.pose_loss(T, batch.T_frame_link, batch.segments.real).mean()
    posed = apply(batch.segments.poses_of_points(T), batch.local)
    parts["penetration"] = losses.penetration_loss(posed, batch.obj, batch.normals, batch.segments.kept).mean()
    nats = losses.divergence(output.mean, output.log_variance)
    parts["divergence"] = losses.divergence_loss(nats, config.losses.divergence_form)
    if model.placement is not None:
        parts["motion"] = (output.moved - batch.grasp).norm(dim=-1).mean()
        parts["flow"] = output.flow_error.mean()
        parts["placement"] = placement_losses(model.placement, batch, config.augmentation.proportions, generator)["total"]
    weights = {name: getattr(config.losses, name) for name in parts}
    total = torch.stack([weights[name] * value for name, value in parts.items()]).sum()
    return {"total": total, **parts, "nats": nats.sum(-1).mean()}


def train_placement(
    bundle: Bundle, network: NetworkConfig, config: PlacementConfig, folder: Path, initial: DistanceNetwork,
    report: Report | None = None, name: str = "trained",
) -> DistanceNetwork:
    """Train the placement prior of given weights, and nothing else; arguments, result and errors as those of `train`."""
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

    def draw(generator: torch.Generator) -> Batch:
        return source.draw_batch(config.hands_per_step, config.samples_per_hand, config.by_count, None, generator)

    def step(batch: Batch) -> Losses:
        return placement_losses(prior, batch, config.augmentation.proportions, generator)

    run.train(step, report or console_report("placement"), draw)
    return model.cpu().eval()


def measure_hands(model: DistanceNetwork, source: SampleSource) -> None:
    """Let a placement prior know the proportions of the hands in training."""
    if model.placement is not None:
        model.placement.standardised.measure(torch.stack([source.proportions[name] for name in source.names]))


def placement_losses(
    prior: PlacementPrior, batch: Batch, noise: float, generator: torch.Generator
) -> Losses:
    """The prior's loss as `total`, and what it has learned, with `noise` on proportions, in their spreads.

    `log_density` is that of true positions [nat], `preferred` the share of pairs of a true and a random rotation in which the
    true one has the higher score.
    """
    rows = batch.proportions
    hand = rows + noise * prior.standardised.spread * torch.randn(rows.shape, generator=generator, device=rows.device)
    density, score = prior.log_density(batch.obj_hand, hand, batch.position)
    other_score = prior(batch.obj_random, hand)[3]
    preferred = (score[:, None] > other_score).float().mean()
    return {"total": losses.placement_loss(density, score, other_score), "log_density": density.mean(), "preferred": preferred}
