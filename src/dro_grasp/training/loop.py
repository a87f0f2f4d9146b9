"""Main training of the D(R,O) network, and of its placement prior alone, which shares no parameter with the rest.

Source: paper section III-E; the prior is ours.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

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
from dro_grasp.training.samples import HandSamples, SampleSource


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

    draw = _drawing(source, config)
    run.train(lambda: step_losses(model, run.drawn(draw), config, generator), report or console_report("training"))
    run.seed_shard()
    recalibrate(model, lambda: model(*_clouds(draw(generator)), generator, columns=1), config.schedule.recalibration)
    model.mixed = False
    return model.cpu().eval()


def step_losses(
    model: DistanceNetwork, groups: list[HandSamples], config: TrainConfig, generator: torch.Generator
) -> Losses:
    """All losses of one batch, by name, with their weighted sum as `total`, and the plain divergence as `nats`."""
    placed, obj, grasp = _clouds(groups)
    output = model(placed, obj, grasp, generator, columns=config.columns)
    anchors = obj[:, : config.columns]
    parts = {"distance": losses.distance_loss(output.distances, distance_matrix.build(grasp, anchors))}
    segments = distance_matrix.together([group.segments for group in groups])
    T, _, _ = distance_matrix.decode_segments(segments, output.distances, anchors)
    true = torch.cat([group.T_frame_link[:, group.segments.links[0]] for group in groups])
    parts["pose"] = losses.pose_loss(T, true, segments.real).mean()
    local = torch.cat([group.hand.link_points.expand(len(group.placed), -1, -1) for group in groups])
    posed, normals = apply(segments.poses_of_points(T), local), torch.cat([group.normals for group in groups])
    parts["penetration"] = losses.penetration_loss(posed, obj, normals, segments.kept).mean()
    nats = losses.divergence(output.mean, output.log_variance)
    parts["divergence"] = losses.divergence_loss(nats, config.losses.divergence_form)
    if model.placement is not None:
        parts["motion"] = (output.moved - grasp).norm(dim=-1).mean()
        parts["flow"] = output.flow_error.mean()
        parts["placement"] = placement_losses(model.placement, groups, config.augmentation.proportions, generator)["total"]
    weights = {name: getattr(config.losses, name) for name in parts}
    total = torch.stack([weights[name] * value for name, value in parts.items()]).sum()
    return {"total": total, **parts, "nats": nats.sum(-1).mean()}


def _drawing(
    source: SampleSource, config: TrainConfig | PlacementConfig
) -> Callable[[torch.Generator], list[HandSamples]]:
    """What draws the samples of a shard."""
    return lambda generator: source.draw_all(
        source.draw_hands(config.hands_per_step, generator, config.by_count), config.samples_per_hand, generator)


def _clouds(groups: list[HandSamples]) -> tuple[Float[Tensor, "b n 3"], Float[Tensor, "b m 3"], Float[Tensor, "b n 3"]]:
    placed, obj, grasp = (torch.cat([getattr(g, n) for g in groups]) for n in ("placed", "obj", "grasp"))
    return placed, obj, grasp


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

    draw = _drawing(source, config)

    def step() -> Losses:
        return placement_losses(prior, run.drawn(draw), config.augmentation.proportions, generator)

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
