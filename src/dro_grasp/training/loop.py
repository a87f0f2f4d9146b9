"""Main training of the D(R,O) network. Source: paper section III-E."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from dro_grasp import distance_matrix
from dro_grasp.datasets.bundle.training_file import Bundle
from dro_grasp.models.network import DistanceNetwork, NetworkConfig, NetworkOutput
from dro_grasp.training.batch_statistics import recalibrate
from dro_grasp.training.config import TrainConfig
from dro_grasp.training.losses import (
    distance_loss,
    divergence,
    divergence_loss,
    penetration_loss,
    placement_loss,
    pose_loss,
)
from dro_grasp.training.processes import join
from dro_grasp.training.reports import console_report
from dro_grasp.training.runs import Run
from dro_grasp.training.samples import HandSamples, SampleSource


def train(
    bundle: Bundle,
    network: NetworkConfig,
    config: TrainConfig,
    folder: Path,
    pretrained: DistanceNetwork | None = None,
    report: Callable[[Run, dict[str, float]], None] | None = None,
    name: str = "trained",
    initial: DistanceNetwork | None = None,
) -> DistanceNetwork:
    """Train on a bundle.

    Args:
        bundle: Hands, objects and grasps.
        network: Sizes and forms.
        config: Losses, augmentation and schedule.
        folder: Run folder; a checkpoint in it is taken up, to the same curve.
        pretrained: Where the hand encoder comes from; without it, and without `initial`, the encoder is trained along.
        report: Called now and then; the console by default.
        name: How the weights are called.
        initial: Weights to go on from, as in fine-tuning; what the network has of another shape starts afresh.

    Returns:
        The moving average of the weights, on the CPU, in evaluation mode.

    Raises:
        TrainingError: A loss is not finite.
    """
    processes, device = join(config.schedule.device)
    torch.manual_seed(config.schedule.seed)
    generator = torch.Generator(device)
    model = DistanceNetwork(network, name=name).to(device)
    frozen = (pretrained is not None or initial is not None) and config.freeze_hand_encoder
    if initial is not None:
        take_over(model, initial)
    if pretrained is not None:
        model.hand_encoder.load_state_dict(pretrained.hand_encoder.state_dict())
        if model.motion is not None and pretrained.motion is not None:
            model.motion.load_state_dict(pretrained.motion.state_dict())
    model.hand_encoder.requires_grad_(not frozen)
    model.mixed = config.schedule.mixed
    source = SampleSource(bundle, network, config.augmentation, device)
    run = Run(folder, model, config.schedule, generator, processes)
    model.train()
    if frozen:
        # train() would put the frozen encoder's BatchNorm back into training mode.
        model.hand_encoder.eval()

    def draw() -> list[HandSamples]:
        names = source.draw_hands(config.hands_per_step, generator)
        return [source.draw(hand, config.samples_per_hand, generator) for hand in names]

    run.train(lambda: step_losses(model, draw(), config, run.progress), report or console_report("training"))
    model.load_state_dict(run.average.module.state_dict())
    run.seed_shard()
    recalibrate(model, lambda: model(*_clouds(draw()), columns=1))
    model.mixed = False
    return model.cpu().eval()


def take_over(model: DistanceNetwork, other: DistanceNetwork) -> list[str]:
    """Copy the tensors that both networks have in the same shape; returns the names of the others, which stay."""
    theirs, ours = other.state_dict(), model.state_dict()
    same = {name: value for name, value in theirs.items() if name in ours and value.shape == ours[name].shape}
    model.load_state_dict(same, strict=False)
    return sorted(set(ours) - set(same))


def step_losses(
    model: DistanceNetwork, groups: list[HandSamples], config: TrainConfig, progress: float = 1.0
) -> dict[str, Tensor]:
    """All losses of one batch, by name, with their weighted sum as `total`, and the plain divergence as `nats`.

    Args:
        model: The network, in training mode.
        groups: Samples of one or several hands.
        config: Weights.
        progress: How much of the schedule is behind, from 0 to 1.
    """
    placed, obj, grasp = _clouds(groups)
    output = model(placed, obj, grasp, columns=config.columns)
    anchors = obj[:, : config.columns]
    parts = {"distance": distance_loss(output.distances, distance_matrix.build(grasp, anchors))}
    poses, penetrations = [], []
    start = 0
    for group in groups:
        rows = slice(start, start + len(group.placed))
        decoded = distance_matrix.decode(group.hand, output.distances[rows], anchors[rows])
        poses.append(pose_loss(decoded.T_world_link, group.T_frame_link, decoded.valid))
        posed = _posed_points(group, decoded)
        penetrations.append(penetration_loss(posed, group.obj, group.normals))
        start = rows.stop
    parts["pose"] = torch.cat(poses).mean()
    parts["penetration"] = torch.cat(penetrations).mean()
    nats = divergence(output.mean, output.log_variance, output.prior_mean, output.prior_log_variance)
    parts["divergence"] = divergence_loss(nats, config.losses.divergence_form, config.losses.free_bits)
    if model.motion is not None:
        parts["motion"] = (output.moved - grasp).norm(dim=-1).mean()
    parts["flow"] = output.flow_error.mean()
    parts["placement"] = _placement(model, groups, output)
    weights = {name: getattr(config.losses, name) for name in parts}
    if progress < config.losses.divergence_warmup:
        weights["divergence"] *= progress / config.losses.divergence_warmup
    total = torch.stack([weights[name] * value for name, value in parts.items()]).sum()
    return {"total": total, **parts, "nats": nats.sum(-1).mean()}


def _clouds(groups: list[HandSamples]) -> tuple[Tensor, Tensor, Tensor]:
    """The network's inputs: open hands, objects, grasps."""
    placed, obj, grasp = (torch.cat([getattr(g, n) for g in groups]) for n in ("placed", "obj", "grasp"))
    return placed, obj, grasp


def _posed_points(group: HandSamples, decoded: distance_matrix.LinkPoses) -> Tensor:
    """Hand points under the decoded link poses (b k 3), of the links that have one."""
    kept = decoded.valid[group.hand.link_index]
    T = decoded.T_world_link[:, group.hand.link_index[kept]]
    return (T[..., :3, :3] @ group.hand.link_points[kept][..., None])[..., 0] + T[..., :3, 3]


def _placement(model: DistanceNetwork, groups: list[HandSamples], output: NetworkOutput) -> Tensor:
    feature = output.hand_feature.detach()
    obj, other, position = (
        torch.cat([getattr(g, n) for g in groups]) for n in ("obj_hand", "obj_random", "position")
    )
    density, score = model.placement.log_density(obj, feature, position)
    other_score = model.placement(other, feature)[3]
    return placement_loss(density, score, other_score)
