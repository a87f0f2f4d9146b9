"""The grasp controller: a pregrasp farther from the object and a squeeze closer to it, made from a grasp.

Source: paper, appendix, grasp controller; amounts as in the official release.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.geometry import se3
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller_config import ControllerConfig
from dro_grasp.hands.hand import Hand


def complete(
    hand: Hand, grasps: GraspBatch, centre: Float[Tensor, "3"] | Float[Tensor, "#n 1 3"], config: ControllerConfig | None = None
) -> GraspBatch:
    """The same grasps, each with pregrasp and squeeze; rows that are stated stay. `centre` as below."""
    open_rows = ~grasps.states_closing
    if not bool(open_rows.any()):
        return grasps
    centre = centre.to(grasps.joints)
    made = pregrasp_and_squeeze(
        hand, grasps.T_object_wrist[open_rows], grasps.joints[open_rows],
        centre[open_rows] if len(centre) == len(grasps) and centre.ndim > 1 else centre, config)
    postures = []
    for given, new in zip((grasps.pregrasp_joints, grasps.squeeze_joints), made, strict=True):
        whole = given.clone()
        whole[open_rows] = new
        postures.append(torch.where(given.isfinite().all(-1, keepdim=True), given, whole))
    return grasps.replace(pregrasp_joints=postures[0], squeeze_joints=postures[1])


def pregrasp_and_squeeze(
    hand: Hand, T_object_wrist: Float[Tensor, "n 4 4"], joints: Float[Tensor, "n n_dof"],
    centre: Float[Tensor, "3"] | Float[Tensor, "#n 1 3"], config: ControllerConfig | None = None,
) -> tuple[Float[Tensor, "n n_dof"], Float[Tensor, "n n_dof"]]:
    """Joint values q_outer and q_inner of each grasp [rad or m].

    Each finger joint moves away from the object's centre, or another of each grasp [m], and towards it. The derivative of
    the mean distance between
    the downstream points and the centre gives the direction, for each grasp and joint. Joints that only spread the fingers,
    joints above the palm and the wrist stay.
    """
    config = config or ControllerConfig()
    slope = distance_slope(hand, T_object_wrist, joints, centre)
    moves = hand.movable & ~hand.abduction & (slope.abs() > config.dead_zone)
    # The pregrasp opens as far as the hand opens; a grasp that is beyond already opens no farther.
    lower = torch.maximum(torch.minimum(hand.lower, joints), hand.tree.lower)
    upper = hand.upper.clamp(joints, hand.tree.upper)
    away = torch.where(slope > 0, upper, lower)
    towards = torch.where(slope > 0, lower, upper)
    outer = torch.where(moves, joints + config.outer * (away - joints), joints)
    inner = torch.where(moves, joints + config.inner * (towards - joints), joints)
    return outer.clamp(lower, upper), inner.clamp(lower, upper)


def distance_slope(
    hand: Hand, T_object_wrist: Float[Tensor, "n 4 4"], joints: Float[Tensor, "n n_dof"],
    centre: Float[Tensor, "3"] | Float[Tensor, "#n 1 3"],
) -> Float[Tensor, "n n_dof"]:
    """Derivative by each joint of the mean distance of its downstream points to the object's centre [m/rad or m/m]."""
    tree = hand.tree
    poses = T_object_wrist[:, None] @ tree.forward(joints)
    # The mean of each link's points stands for them: the mean distance hardly differs, and links are few.
    links, middles = hand.point_links, hand.link_middles
    points = se3.apply(poses[:, links], middles)
    offset = points - centre
    direction = offset / offset.norm(dim=-1, keepdim=True).clamp(min=1e-9)
    jacobian = tree.point_jacobian(poses, points, links)
    rate = (direction[..., None] * jacobian).sum(-2)
    moved = tree.moves[links].to(rate.dtype)
    return (rate * moved).sum(1) / moved.sum(0).clamp(min=1)
