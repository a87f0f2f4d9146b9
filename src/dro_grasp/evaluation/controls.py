"""Controls: what success means nothing without.

A lenient trial is passed by grasps that never looked at the object; these are they.
"""

from __future__ import annotations

from dataclasses import dataclass

import roma
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.datasets.bundle.training_file import Bundle
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import completed
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel


@dataclass(frozen=True)
class MeanGrasp:
    """The mean over training grasps of a hand, in the wrist frame."""

    joints: Float[Tensor, " n_dof"]
    """[rad or m]"""
    object_centre: Float[Tensor, "3"]
    """Where the object's centre is, in the wrist frame [m]."""


def mean_grasp(bundle: Bundle, hand_name: str) -> MeanGrasp:
    """The mean grasp of a hand in a training bundle.

    Raises:
        KeyError: The bundle has no such hand.
    """
    grasps = bundle.grasps[hand_name]
    centres = torch.stack([cloud.points.mean(0) for cloud in bundle.objects.values()])[grasps.object_index]
    T_wrist_object = torch.linalg.inv(grasps.T_object_wrist)
    positions = (T_wrist_object[:, :3, :3] @ centres[..., None])[..., 0] + T_wrist_object[:, :3, 3]
    return MeanGrasp(grasps.joints.mean(0), positions.mean(0))


def mean_grasps(hand: Hand, obj: ObjectModel, mean: MeanGrasp, num: int, seed: int) -> GraspBatch:
    """The mean grasp at random wrist rotations; it ignores the object's shape and size."""
    generator = torch.Generator().manual_seed(seed)
    rotation = _random_rotations(num, generator)
    centre = torch.from_numpy(obj.cloud).mean(0)
    T = _poses(rotation, centre - (rotation @ mean.object_centre))
    return _complete(hand, obj, T, mean.joints.expand(num, -1).contiguous(), seed, "control: mean grasp")


def palm_facing_starts(hand: Hand, obj: ObjectModel, num: int, seed: int) -> GraspBatch:
    """Open hands that face the object with the palm at its surface: starts of synthesis, never optimised.

    The palm's axis goes through the object's centre; the palm's centre is at the object's extent along that axis, or up
    to a centimetre before it. Joints are half closed.
    """
    generator = torch.Generator().manual_seed(seed)
    rotation = _random_rotations(num, generator)
    cloud = torch.from_numpy(obj.cloud)
    centre = cloud.mean(0)
    direction = rotation @ hand.palm_direction_wrist
    palm = hand.T_wrist_palm_rest
    palm_centre = palm[:3, :3] @ hand.palm_centre + palm[:3, 3]
    reach = -((cloud - centre) @ direction.mT).amin(0)
    gap = 0.01 * torch.rand(num, generator=generator)
    surface = centre - (reach + gap)[:, None] * direction
    T = _poses(rotation, surface - rotation @ palm_centre)
    joints = hand.canonical_joints(0.5).expand(num, -1).contiguous()
    return _complete(hand, obj, T, joints, seed, "control: palm-facing start")


def _poses(rotation: Float[Tensor, "n 3 3"], position: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4 4"]:
    T = torch.eye(4).repeat(len(rotation), 1, 1)
    T[:, :3, :3], T[:, :3, 3] = rotation, position
    return T


def _complete(hand: Hand, obj: ObjectModel, T: Tensor, joints: Tensor, seed: int, origin: str) -> GraspBatch:
    centre = torch.as_tensor(obj.centre_of_mass, dtype=joints.dtype)
    return completed(hand, GraspBatch.create(hand, obj, T, joints, seed=seed, provenance=origin), centre)


def _random_rotations(num: int, generator: torch.Generator) -> Float[Tensor, "num 3 3"]:
    quaternion = torch.nn.functional.normalize(torch.randn(num, 4, generator=generator), dim=-1)
    return roma.unitquat_to_rotmat(quaternion)
