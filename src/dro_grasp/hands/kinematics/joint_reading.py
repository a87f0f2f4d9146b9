"""Joint values from link poses: the initial guess of the joint solver.

Where the poses of two links are known, each joint between them takes the value that brings the lower link closest to
its known pose. Source: ours; the paper starts from the given open hand.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.geometry.se3 import invert, rotate
from dro_grasp.hands.kinematics.tree import FIXED, REVOLUTE, KinematicTree

ROUNDS = 8  # Sweeps of coordinate descent where several joints lie between two known links (ours)
RIDGE = 1e-6  # Pull towards the given values, for joints that no pose determines [1] (ours)


@torch.no_grad()
def read_joints(
    tree: KinematicTree, T_world_link: Float[Tensor, "*b n_links 4 4"], valid: Bool[Tensor, " n_links"],
    q: Float[Tensor, "*b n_dof"],
) -> Float[Tensor, "*b n_dof"]:
    """Joints that reproduce the relative poses of neighbouring known links, inside their limits; noise is allowed.

    Joints that no pair of links with a `valid` pose encloses keep the values from which the sweeps start, q [rad or m].
    """
    segments = _segments(tree, valid)
    if not segments:
        return q
    known = torch.zeros(len(tree.moving_names), dtype=torch.bool, device=q.device)
    known[[tree.link_joint[link] for _, _, chain in segments for link in chain]] = True
    longest = max(len(chain) for _, _, chain in segments)
    for _ in range(1 if longest == 1 else ROUNDS):
        for place in range(longest):
            rows = [(top, bottom, chain[place]) for top, bottom, chain in segments if len(chain) > place]
            top, bottom, moving = (torch.tensor(column, device=q.device) for column in zip(*rows, strict=True))
            q = _update(tree, T_world_link, q, known, top, bottom, moving)
    return q


def _segments(tree: KinematicTree, valid: Bool[Tensor, " n_links"]) -> list[tuple[int, int, list[int]]]:
    """Triples: a known link, the next known link below it, and the moving links between them, topmost first."""
    found = []
    for bottom in valid.nonzero()[:, 0].tolist():
        chain, link = [], bottom
        while link >= 0 and (link == bottom or not bool(valid[link])):
            if tree.kind[link] != FIXED:
                chain.append(link)
            link = tree.parent[link]
        if link >= 0 and chain:
            found.append((link, bottom, chain[::-1]))
    return found


def _update(
    tree: KinematicTree, target: Float[Tensor, "*b n_links 4 4"], q: Float[Tensor, "*b n_dof"],
    known: Bool[Tensor, " n_joints"], top: Int[Tensor, " s"], bottom: Int[Tensor, " s"], moving: Int[Tensor, " s"],
) -> Float[Tensor, "*b n_dof"]:
    """Set one joint of each segment to its best value and keep the others."""
    poses = tree.forward(q)
    parent = torch.tensor(tree.parent, device=q.device)[moving]
    # T_top_bottom = before @ joint motion @ after: solve for the motion that gives the wanted relative pose.
    before = invert(poses[..., top, :, :]) @ poses[..., parent, :, :] @ tree.origin[moving]
    after = invert(poses[..., moving, :, :]) @ poses[..., bottom, :, :]
    wanted = invert(target[..., top, :, :]) @ target[..., bottom, :, :]
    motion = invert(before) @ wanted @ invert(after)
    x = q @ tree.coupling.T + tree.offset
    joint = torch.tensor(tree.link_joint, device=q.device)[moving]
    x[..., joint] = _joint_value(tree, motion, moving, x[..., joint])
    return _independent(tree, x, q, known)


def _joint_value(
    tree: KinematicTree, motion: Float[Tensor, "*b s 4 4"], moving: Int[Tensor, " s"], near: Float[Tensor, "*b s"]
) -> Float[Tensor, "*b s"]:
    """Angle about, or shift along, each joint's axis a that comes closest to a motion (R, t).

    The rotation about a closest to R in the Frobenius norm maximises trace(R(x)^T R), which is
    sin(x) (a . v) + cos(x) (trace R - a^T R a) + a^T R a, with v the axial vector of R - R^T.
    """
    axis = tree.axis[moving]
    rotation = motion[..., :3, :3]
    turned = torch.stack([
        rotation[..., 2, 1] - rotation[..., 1, 2],
        rotation[..., 0, 2] - rotation[..., 2, 0],
        rotation[..., 1, 0] - rotation[..., 0, 1],
    ], -1)
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1)
    along = (axis * rotate(rotation, axis)).sum(-1)
    angle = torch.atan2((axis * turned).sum(-1), trace - along)
    # Angles are equal up to whole turns: take the one nearest to the present value.
    angle = angle + 2 * math.pi * torch.round((near - angle) / (2 * math.pi))
    revolute = torch.tensor(tree.kind, device=axis.device)[moving] == REVOLUTE
    return torch.where(revolute, angle, (axis * motion[..., :3, 3]).sum(-1))


def _independent(
    tree: KinematicTree, x: Float[Tensor, "*b n_joints"], q: Float[Tensor, "*b n_dof"], known: Bool[Tensor, " n_joints"]
) -> Float[Tensor, "*b n_dof"]:
    """Independent joints that fit all known joints best; the fit is exact without couplings."""
    rows = tree.coupling[known]
    matrix = rows.T @ rows + RIDGE * torch.eye(tree.n_dof, dtype=q.dtype, device=q.device)
    right = (x - tree.offset)[..., known] @ rows + RIDGE * q
    fitted = torch.linalg.solve(matrix, right[..., None])[..., 0]
    return fitted.clamp(tree.lower, tree.upper)
