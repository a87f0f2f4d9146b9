"""The terms of the grasp energy, each with its gradient, and the way from forces on links to joint gradients.

Every term returns unreduced values and their derivatives by the positions (and normals) it was given; callers
weigh and sum. No automatic differentiation: a term's derivative is a force on a point fixed to a link, forces
are summed to a wrench per link, and `joint_gradient` carries the wrenches down the tree. Source of the terms:
DexGraspNet (Wang et al. 2022), which the paper names for its ranking; the differences are noted at each term.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dro_grasp.kinematics.tree import KinematicTree


class PointTerm(NamedTuple):
    """Values of a term that depends on positions."""

    value: Tensor
    """Unreduced, (*b k)."""
    by_point: Tensor
    """Derivative of the summed values by the points given, (*b c 3) [1/m times the value's unit]."""


class NormalTerm(NamedTuple):
    """Values of a term that depends on directions."""

    value: Tensor
    """Unreduced, (*b k)."""
    by_normal: Tensor
    """Derivative of the summed values by the normals given, (*b c 3)."""


class ContactTerm(NamedTuple):
    """Values of a term that depends on positions and directions."""

    value: Tensor
    """Unreduced, (*b k)."""
    by_point: Tensor
    """As in PointTerm."""
    by_normal: Tensor
    """As in NormalTerm."""


def force_closure(
    points: Float[Tensor, "*b c 3"], normals: Float[Tensor, "*b c 3"], length: float
) -> ContactTerm:
    """Squared components of the net wrench of unit forces along the contact normals, (*b 6).

    Zero means that equal normal forces alone hold the object: the differentiable relaxation of force closure.

    Args:
        points: Contacts relative to the object's centre of mass [m].
        normals: Outward unit normals of the object at the contacts.
        length: Torques are divided by this length [m], so that force and torque weigh alike.
    """
    # Differs from DexGraspNet: torques are about the centre of mass and scaled by the object's size.
    force = normals.sum(-2)
    torque = torch.linalg.cross(points, normals, dim=-1).sum(-2) / length
    wrench = torch.cat([force, torque], -1)
    arm = 2 * torque[..., None, :] / length
    by_point = torch.linalg.cross(normals, arm.expand_as(normals), dim=-1)
    by_normal = 2 * force[..., None, :] + torch.linalg.cross(arm.expand_as(points), points, dim=-1)
    return ContactTerm(wrench**2, by_point, by_normal)


def contact_distance(distance: Float[Tensor, "*b c"], gradient: Float[Tensor, "*b c 3"]) -> PointTerm:
    """Distance of each contact to the object's surface, inside or outside [m].

    Args:
        distance: Signed distance at the contacts [m].
        gradient: Its gradient there.
    """
    return PointTerm(distance.abs(), distance.sign()[..., None] * gradient)


def normal_alignment(
    hand_normals: Float[Tensor, "*b c 3"], object_normals: Float[Tensor, "*b c 3"]
) -> NormalTerm:
    """One plus the cosine between hand and object normal at each contact: 0 where they oppose.

    `by_normal` is the derivative by the hand's normals; that by the object's is `hand_normals` itself.
    """
    return NormalTerm(1 + (hand_normals * object_normals).sum(-1), object_normals)


def penetration(distance: Float[Tensor, "*b p"], gradient: Float[Tensor, "*b p 3"]) -> PointTerm:
    """Depth of each hand point inside the object [m], zero outside.

    Args:
        distance: Signed distance at points of the hand's surface [m].
        gradient: Its gradient there.
    """
    # Differs from DexGraspNet, which sums over object points inside the hand: here hand points in the object.
    inside = (distance < 0).to(distance.dtype)
    return PointTerm(-distance * inside, -gradient * inside[..., None])


def self_penetration(
    centres: Float[Tensor, "*b s 3"], radii: Float[Tensor, " s"], pairs: Int[Tensor, "k 2"]
) -> PointTerm:
    """Overlap of the pairs of spheres that stand for links which may not touch [m], (*b k)."""
    first, second = pairs[:, 0], pairs[:, 1]
    one_hot = torch.eye(len(radii), dtype=centres.dtype, device=centres.device)
    difference = one_hot[first] - one_hot[second]
    # As plain matrix products, several times faster than gathering and adding by index.
    apart = (centres.mT.reshape(-1, len(radii)) @ difference.T).unflatten(0, (*centres.shape[:-2], 3))
    distance = apart.square().sum(-2).clamp_min(1e-12).sqrt()
    overlap = radii[first] + radii[second] - distance
    touching = (overlap > 0).to(centres.dtype)
    push = -apart * (touching / distance)[..., None, :]
    by_point = (push.reshape(-1, len(pairs)) @ difference).unflatten(0, (*centres.shape[:-2], 3)).mT
    return PointTerm(overlap * touching, by_point)


def joint_margin(
    q: Float[Tensor, "*b n_dof"], lower: Float[Tensor, " n_dof"], upper: Float[Tensor, " n_dof"]
) -> tuple[Float[Tensor, "*b n_dof"], Float[Tensor, "*b n_dof"]]:
    """How far each joint lies beyond the given limits [rad or m], and the derivative by q.

    The limits are those of the hand narrowed where a joint needs room to squeeze; the hand's own are kept
    by projection, not by this term.
    """
    above, below = q - upper, lower - q
    value = above.clamp_min(0) + below.clamp_min(0)
    return value, (above > 0).to(q.dtype) - (below > 0).to(q.dtype)


def link_wrenches(
    points: Float[Tensor, "*b p 3"], by_point: Float[Tensor, "*b p 3"], members: Float[Tensor, "p n_links"]
) -> Float[Tensor, "*b n_links 6"]:
    """Sum derivatives by points to one derivative per rigid motion of each link (translation, rotation).

    Args:
        points: World positions [m].
        by_point: Derivatives by them.
        members: One-hot link of each point.
    """
    moment = torch.linalg.cross(points, by_point, dim=-1)
    both = torch.cat([by_point.mT, moment.mT], -2)
    return (both.reshape(-1, len(members)) @ members).unflatten(0, both.shape[:-1]).mT


def joint_gradient(
    tree: KinematicTree,
    T_world_link: Float[Tensor, "*b n_links 4 4"],
    wrenches: Float[Tensor, "*b n_links 6"],
    pivot: Float[Tensor, "*b 3"],
) -> tuple[Float[Tensor, "*b 6"], Float[Tensor, "*b n_dof"]]:
    """Derivatives by a small motion of the whole hand and by each independent joint.

    Args:
        tree: The hand's tree.
        T_world_link: Poses of all links.
        wrenches: Derivative by each link's translation and by its rotation about the world's origin.
        pivot: The whole hand is turned about this point [m].

    Returns:
        Derivative by (translation, rotation about the pivot) of the hand, and by the joints.
    """
    carried = tree.descends.to(wrenches.dtype).T @ wrenches
    linear, angular = tree.motion_axes(T_world_link)
    per_link = (linear * carried[..., :3] + angular * carried[..., 3:]).sum(-1)
    force, moment = wrenches[..., :3].sum(-2), wrenches[..., 3:].sum(-2)
    moment = moment - torch.linalg.cross(pivot, force, dim=-1)
    return torch.cat([force, moment], -1), per_link @ tree.link_coupling
