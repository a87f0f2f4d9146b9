"""Training of contacts from a bundle. Source: ManiFM (Xu et al. 2024); differences are noted."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.hands.hand import Hand
from dro_grasp.training.data.bundle.training_file import Bundle
from dro_grasp.training.runs import Losses, Report, console_report
from lab.methods.bundle_draws import BundleDraws
from lab.methods.manifm.contact_network import LATENT, ContactNetwork, ContactOutput
from lab.methods.manifm.fingertip_contacts import ContactMaps, contact_maps
from lab.methods.point_autoencoder import AutoencoderConfig, divergence, train_autoencoder

HAND_POINTS = 64
"""Points of the open hand that the network is told (ours)."""


@dataclass(frozen=True)
class ContactTrainingConfig(AutoencoderConfig):
    """Settings; the numbers are ManiFM's, unless stated otherwise."""

    batch: int = 64
    """Grasps in a step."""
    force: float = 100.0
    """Weight of the squared error of forces, beside that of the heat."""
    divergence: tuple[float, float] = (1e-7, 0.05)
    """Weight of the divergence of z from N(0, I) at the start and the end; it grows by equal factors."""


def train_contacts(
    bundle: Bundle, config: ContactTrainingConfig, folder: Path, report: Report | None = None
) -> ContactNetwork:
    """See `train_autoencoder`."""
    return train_autoencoder(
        ContactNetwork, bundle, config, folder, _forward, contact_losses, report or console_report("contacts"))


def _forward(
    model: ContactNetwork, draws: BundleDraws, config: ContactTrainingConfig, generator: torch.Generator
) -> tuple[ContactMaps, ContactOutput]:
    """True contacts of a batch, and the network's."""
    obj, told, true = draw_contacts(draws, config, generator)
    return true, model(obj, told, true, torch.randn(len(obj), LATENT, generator=generator, device=generator.device))


def draw_contacts(
    draws: BundleDraws, config: ContactTrainingConfig, generator: torch.Generator
) -> tuple[Float[Tensor, "b m 6"], Float[Tensor, "b n 6"], ContactMaps]:
    """Objects, open hands and true contacts of one step, of one or two hands."""
    parts = []
    for _ in range(2):
        drawn = draws.draw(config.batch // 2, config.points, generator)
        true = contact_maps(drawn.points, drawn.normals, drawn.hand, drawn.body)
        told = open_hand_cloud(drawn.hand).expand(len(drawn.points), -1, -1)
        parts.append((torch.cat([drawn.points, drawn.normals], -1), told, true.heat, true.force))
    obj, told, heat, force = (torch.cat(part) for part in zip(*parts, strict=True))
    return obj, told, ContactMaps(heat, force)


def open_hand_cloud(hand: Hand) -> Float[Tensor, "n 6"]:
    """Points of the open hand in its palm's axes about its grasp centre [m], and normals there."""
    thin = hand.with_points(min(HAND_POINTS, hand.n_points))
    points, normals = thin.points_and_normals(hand.canonical_joints())
    told = torch.cat([(points - hand.grasp_centre_wrist) @ hand.palm_axes_wrist, normals @ hand.palm_axes_wrist], -1)
    return told[torch.arange(HAND_POINTS, device=told.device) % len(told)]


def contact_losses(passed: tuple[ContactMaps, ContactOutput], config: ContactTrainingConfig, progress: float) -> Losses:
    """Losses of one batch; `progress` is the share of the schedule that is done."""
    true, output = passed
    heat = (output.maps.heat - true.heat).square().mean()
    force = (output.maps.force - true.force).square().mean()
    nats = divergence(output.mean, output.log_variance)
    first, last = config.divergence
    weight = first * math.exp(progress * math.log(last / first))
    total = heat + config.force * force + weight * ((1 + nats.square()).sqrt() - 1)
    return {"total": total, "heat": heat, "force": force, "nats": nats}
