"""Configuration-invariant pretraining of the hand encoder. Source: paper section III-B."""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.errors import TrainingError
from dro_grasp.network.encoder import StaticGraphEncoder
from dro_grasp.network.latent import HandMotion, sample_posterior
from dro_grasp.network.network import DistanceNetwork, take_initial, untrained_network
from dro_grasp.network.presets import NetworkConfig
from dro_grasp.training.config import AugmentationConfig, MotionConfig, PretrainConfig
from dro_grasp.training.data.bundle.training_file import Bundle
from dro_grasp.training.losses import contrastive_loss, divergence
from dro_grasp.training.runs import Losses, Report, TrainingRun, begin, console_report, recalibrate, run_plan
from dro_grasp.training.samples import SampleSource, random_turns


def pretrain(
    bundle: Bundle, network: NetworkConfig, config: PretrainConfig, folder: Path, report: Report | None = None,
    initial: DistanceNetwork | None = None,
) -> DistanceNetwork:
    """Pretrain the hand encoder on the bundle's hands: on their grasps, and on any pose of those without.

    Arguments and errors are those of `train`.

    Returns:
        A network with a trained hand encoder and otherwise as it began, on the CPU, in evaluation mode.
    """
    processes, device = begin(config.schedule)
    whole = untrained_network(network, config.schedule.seed, "pretrained")
    if initial is not None:
        take_initial(whole, initial)
    whole.to(device)
    generator = torch.Generator(device)
    source = SampleSource(bundle, network, AugmentationConfig(), device)
    encoder = whole.hand_encoder
    plan = run_plan(config, bundle, network, initial=initial)
    run = TrainingRun(folder, encoder, config.schedule, generator, processes, plan)
    encoder.train()

    def draw(generator: torch.Generator) -> Clouds:
        return posture_clouds(source, config, generator)

    def losses(clouds: Clouds) -> Losses:
        return {"total": contrastive_step(encoder, clouds, config)}

    run.train(losses, report or console_report("pretraining"), draw)
    run.seed_shard()
    recalibrate(encoder, lambda: losses(draw(generator)), config.schedule.recalibration)
    return whole.cpu().eval()


def pretrain_motion(
    model: DistanceNetwork, bundle: Bundle, config: MotionConfig, folder: Path, report: Report | None = None
) -> DistanceNetwork:
    """Train z to encode how hands move, without objects, in a network whose pretrained hand encoder stays as it is.

    Arguments and errors are those of `train`; the network is returned on the CPU, in evaluation mode.

    Raises:
        TrainingError: z does not move the hand in this network.
    """
    if model.motion is None:
        raise TrainingError(f"a network in frame '{model.config.frame}' has no motion to pretrain; choose frame 'palm'")
    processes, device = begin(config.schedule)
    motion, encoder = model.motion.to(device), model.hand_encoder.to(device).eval()
    generator = torch.Generator(device)
    source = SampleSource(bundle, model.config, config.augmentation, device)
    plan = run_plan(config, bundle, model.config, encoder=encoder)
    run = TrainingRun(folder, motion, config.schedule, generator, processes, plan)
    motion.train()

    def draw(generator: torch.Generator) -> Clouds:
        return motion_clouds(source, config, generator)

    def losses(clouds: Clouds) -> Losses:
        return motion_losses(motion, encoder, clouds, config, generator)

    run.train(losses, report or console_report("motion"), draw)
    return model.cpu().eval()


Clouds = tuple[Float[Tensor, "b n 3"], Float[Tensor, "b n 3"]]  # Of the same hands in two postures [m]


def motion_clouds(source: SampleSource, config: MotionConfig, generator: torch.Generator) -> Clouds:
    """Placed open hands of one step, and what they become."""
    names = source.draw_kinematics(config.hands_per_step, generator)
    drawn = [source.draw_motions(name, config.samples_per_hand, generator) for name in names]
    hand, goal = (torch.cat(clouds) for clouds in zip(*drawn, strict=True))
    return hand, goal


def motion_losses(
    motion: HandMotion, encoder: StaticGraphEncoder, clouds: Clouds, config: MotionConfig, generator: torch.Generator
) -> Losses:
    """Mean distance between moved points and their targets [m], and the divergence [nat]."""
    hand, goal = clouds
    with torch.no_grad():
        features = encoder(hand - hand.mean(1, keepdim=True))
    mean, log_variance = motion.encode(features, hand, goal)
    z = sample_posterior(mean, log_variance, generator)
    distance = (motion(features, hand, z[:, None])[:, 0] - goal).norm(dim=-1).mean()
    nats = divergence(mean, log_variance).sum(-1).mean()
    return {"total": distance + config.divergence * nats, "distance": distance, "nats": nats}


def posture_clouds(source: SampleSource, config: PretrainConfig, generator: torch.Generator) -> Clouds:
    """Hands of one step in grasps (cloud A), and open with a similar wrist rotation (cloud B).

    A network that does not know the placement gets both as in its training: the grasp as it is stored, the open hand tilted.
    """
    grasp_clouds, open_clouds = [], []
    for name in source.draw_kinematics(config.hands_per_step, generator):
        hand = source.hands[name]
        T, joints, centre = source.draw_postures(name, config.samples_per_hand, generator)
        if source.network.placed:
            opened = source.network.axes(hand.palm_axes_wrist).mT.expand(len(T), 3, 3)
            grasping = opened @ random_turns(len(T), config.rotation, generator)
        else:
            opened, grasping = source.tilted(T, centre, generator), T[:, :3, :3]
        grasp_clouds.append(hand.points(joints) @ grasping.mT)
        open_clouds.append(hand.points(hand.random_open_joints(len(T), generator)) @ opened.mT)
    return torch.cat(grasp_clouds), torch.cat(open_clouds)


def contrastive_step(encoder: StaticGraphEncoder, clouds: Clouds, config: PretrainConfig) -> Float[Tensor, ""]:
    """Loss of one batch: grasps (cloud A) against open hands (cloud B)."""
    a, b = clouds
    features_a, features_b = encoder(torch.cat([c - c.mean(1, keepdim=True) for c in (a, b)])).chunk(2)
    return contrastive_loss(features_a, features_b, b, config.temperature, config.sharpness).mean()
