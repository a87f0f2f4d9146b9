"""The terms of the grasp energy with their gradients, and the map from forces on links to joint gradients.

Every term returns unreduced values and their derivatives by the positions (and normals) given; callers weigh and sum
them. There is no automatic differentiation: the derivative of a term is a force on a point fixed to a link, the forces on
each link add up to a wrench, and `joint_gradient` sums the wrenches below each joint. Source of the terms: DexGraspNet
(Wang et al. 2022), which the paper names for its ranking; each term notes its differences.

Axes: *b grasps, c contacts, p points, s spheres, k values of a term.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dro_grasp.hands.kinematics.tree import KinematicTree


class PointTerm(NamedTuple):
    """Unreduced values of a term that depends on positions."""

    value: Float[Tensor, "*b k"]
    by_point: Float[Tensor, "*b c 3"]  # derivative of the summed values by the points given [unit of the value per m]


class ContactTerm(NamedTuple):
    """The same of a term that depends on positions and directions."""

    value: Float[Tensor, "*b k"]
    by_point: Float[Tensor, "*b c 3"]
    by_normal: Float[Tensor, "*b c 3"]  # derivative of the summed values by the normals given


def force_closure(
    points: Float[Tensor, "*b c 3"], normals: Float[Tensor, "*b c 3"], length: float | Float[Tensor, "*b 1"]
) -> ContactTerm:
    """Squared six components of the net wrench of unit forces along the contact normals.

    Zero means that equal normal forces alone hold the object: a differentiable relaxation of force closure. Points are from
    the centre of mass [m]. Torques are divided by `length` [m], so that force and torque have equal weight.
    """
    # Differs from DexGraspNet: torques are about the centre of mass and scaled by the object's size.
    force = normals.sum(-2)
    torque = torch.linalg.cross(points, normals, dim=-1).sum(-2) / length
    wrench = torch.cat([force, torque], -1)
    arm = (2 * torque / length)[..., None, :]
    by_point = torch.linalg.cross(normals, arm.expand_as(normals), dim=-1)
    by_normal = 2 * force[..., None, :] + torch.linalg.cross(arm.expand_as(points), points, dim=-1)
    return ContactTerm(wrench**2, by_point, by_normal)


def contact_distance(distance: Float[Tensor, "*b c"], gradient: Float[Tensor, "*b c 3"]) -> PointTerm:
    """Distance of each contact to the object's surface, from inside or outside, given the signed distance [m]."""
    return PointTerm(distance.abs(), distance.sign()[..., None] * gradient)


def normal_alignment(hand_normals: Float[Tensor, "*b c 3"], object_normals: Float[Tensor, "*b c 3"]) -> Float[Tensor, "*b c"]:
    """One plus the cosine between hand normal and object normal at each contact: 0 if they are opposite.

    Its derivative by the normals of one is the normals of the other.
    """
    return 1 + (hand_normals * object_normals).sum(-1)


def penetration(distance: Float[Tensor, "*b p"], gradient: Float[Tensor, "*b p 3"]) -> PointTerm:
    """Penetration of each hand point into the object, given its signed distance [m]; zero outside."""
    # Differs from DexGraspNet, which sums over object points inside the hand; this sums over hand points inside the object.
    outward = (distance < 0) * -1.0
    return PointTerm(distance * outward, gradient * outward[..., None])


class SpherePairs(NamedTuple):
    """Pairs of spheres that must not overlap, as matrices."""

    difference: Float[Tensor, "k s"]
    """Difference of the one-hot rows of both: one matrix product with it is several times faster than gathering and adding."""
    reach: Float[Tensor, " k"]
    """Sum of the radii [m]."""

    @staticmethod
    def of(radii: Float[Tensor, " s"], pairs: Int[Tensor, "k 2"]) -> SpherePairs:
        """From radii [m] and indices of spheres."""
        first, second = pairs[:, 0], pairs[:, 1]
        one_hot = torch.eye(len(radii), dtype=radii.dtype, device=radii.device)
        return SpherePairs(one_hot[first] - one_hot[second], radii[first] + radii[second])


def self_penetration(centres: Float[Tensor, "*b s 3"], pairs: SpherePairs) -> PointTerm:
    """Overlap of each pair of spheres, on links that must not touch [m]."""
    difference, count = pairs.difference, centres.shape[-2]
    apart = (centres.mT.reshape(-1, count) @ difference.T).unflatten(0, (*centres.shape[:-2], 3))
    distance = apart.square().sum(-2).clamp_min(1e-12).sqrt()
    overlap = pairs.reach - distance
    overlapping = (overlap > 0).to(centres.dtype)
    push = -apart * (overlapping / distance)[..., None, :]
    by_point = (push.flatten(0, -2) @ difference).unflatten(0, (*centres.shape[:-2], 3)).mT
    return PointTerm(overlap * overlapping, by_point)


def joint_margin(
    q: Float[Tensor, "*b n_dof"], lower: Float[Tensor, " n_dof"], upper: Float[Tensor, " n_dof"]
) -> tuple[Float[Tensor, "*b n_dof"], Float[Tensor, "*b n_dof"]]:
    """Distance of each joint beyond the given limits [rad or m], and its derivative by q.

    The limits are the hand's own, narrowed to leave room for the squeeze. The optimiser keeps the hand's own limits by
    projection; this term does not.
    """
    beyond = q - q.clamp(lower, upper)
    return beyond.abs(), beyond.sign()


def link_wrenches(
    points: Float[Tensor, "*b p 3"], by_point: Float[Tensor, "*b p 3"], members: Float[Tensor, "p n_links"]
) -> Float[Tensor, "*b n_links 6"]:
    """Derivatives by the rigid motion of each link (translation, rotation about the world's origin), from those by points.

    The points are world positions [m]; `members` is the one-hot link of each.
    """
    moment = torch.linalg.cross(points, by_point, dim=-1)
    both = torch.cat([by_point.mT, moment.mT], -2)
    return (both.reshape(-1, len(members)) @ members).unflatten(0, both.shape[:-1]).mT


def joint_gradient(
    tree: KinematicTree, T_world_link: Float[Tensor, "*b n_links 4 4"], wrenches: Float[Tensor, "*b n_links 6"],
    pivot: Float[Tensor, "*b 3"],
) -> tuple[Float[Tensor, "*b 6"], Float[Tensor, "*b n_dof"]]:
    """Derivatives by a small motion of the whole hand (translation, rotation about the pivot [m]) and by independent joints.

    The wrenches are derivatives by each link's translation and by its rotation about the world's origin.
    """
    # A joint moves every link below it, so its wrench is the sum of theirs.
    carried = tree.descends.to(wrenches.dtype).T @ wrenches
    linear, angular = tree.motion_axes(T_world_link)
    per_link = (linear * carried[..., :3] + angular * carried[..., 3:]).sum(-1)
    force, moment = wrenches[..., :3].sum(-2), wrenches[..., 3:].sum(-2)
    moment = moment - torch.linalg.cross(pivot, force, dim=-1)
    return torch.cat([force, moment], -1), per_link @ tree.link_coupling
