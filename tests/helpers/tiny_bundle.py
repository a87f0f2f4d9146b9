"""A training bundle of synthetic grasps of two rounded objects, and a network that learns a little of it in seconds."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch

from dro_grasp.geometry.se3 import roma
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.network.presets import NetworkConfig
from dro_grasp.training.data.bundle.training_file import Bundle, ObjectCloud, write_bundle
from tests.helpers.toy_hand import toy_hand

TINY = NetworkConfig(
    n_hand=48, n_object=32, width=16, encoder_widths=(8, 16), neighbours=6, attention_hidden=16, latent=4,
    latent_widths=(8, 16), latent_head=(16, 16), latent_neighbours=6, kernel_hidden=(16, 8), frame="palm",
    placement_width=16,
)
SEMIAXES = {"ball": (0.03, 0.03, 0.03), "egg": (0.02, 0.025, 0.04)}


def ellipsoid(semiaxes: tuple[float, float, float], count: int = 300) -> ObjectCloud:
    """Points and normals of an ellipsoid off the origin [m]."""
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(7)), dim=-1)
    axes = torch.tensor(semiaxes)
    return ObjectCloud(directions * axes + 0.01, torch.nn.functional.normalize(directions / axes, dim=-1))


def made_up_grasps(hand: Hand, obj: str = "ball", count: int = 24, seed: int = 0, **optional: Any) -> GraspBatch:
    """Grasps with the object's centre near the hand's grasp centre, in random rotation."""
    generator = torch.Generator().manual_seed(seed)
    rotation = roma.unitquat_to_rotmat(torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1))
    T = torch.eye(4).repeat(count, 1, 1)
    T[:, :3, :3] = rotation
    T[:, :3, 3] = 0.01 - rotation @ hand.grasp_centre_wrist + 0.003 * torch.randn(count, 3, generator=generator)
    share = 0.4 + 0.1 * torch.rand(count, hand.tree.n_dof, generator=generator)
    joints = hand.canonical_joints(0.0) * (1 - share) + hand.canonical_joints(1.0) * share
    split = optional.pop("split", "train")
    return GraspBatch.create(hand, SimpleNamespace(name=obj, sha256=obj, split=split), T, joints, **optional)


def tiny_bundle(path: Path) -> Bundle:
    """Write the bundle and read it again."""
    hand, clouds = toy_hand(), {name: ellipsoid(axes) for name, axes in SEMIAXES.items()}
    return write_bundle(path, [hand], clouds, [made_up_grasps(hand, name, seed=i) for i, name in enumerate(clouds)])
