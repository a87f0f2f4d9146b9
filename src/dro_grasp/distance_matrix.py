"""D(R,O): the distance of every hand point to every object point in the grasp, built and decoded.

Source: paper section III-C and III-D.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.geometry.mirrored_sides import SideConfig, choose_sides
from dro_grasp.geometry.multilateration import MultilaterationConfig, distance_misfit, multilaterate_both
from dro_grasp.geometry.registration import register
from dro_grasp.hands.hand import Hand
from dro_grasp.kinematics.joint_reading import read_joints
from dro_grasp.kinematics.joint_solver import JointSolution, JointSolverConfig, solve_joints


@dataclass(frozen=True)
class DecodeConfig:
    """Numbers of the decoding."""

    multilateration: MultilaterationConfig = field(default_factory=MultilaterationConfig)
    """Closed form and refinement."""
    sides: SideConfig = field(default_factory=SideConfig)
    """How mirrored candidates are told apart on flat clouds."""


@dataclass(frozen=True)
class LinkPoses:
    """What D(R,O) says about a hand."""

    T_world_link: Float[Tensor, "*b n_links 4 4"]
    """Pose of each link in the frame of the object points; the identity where not valid."""
    residual: Float[Tensor, "*b n_links"]
    """Root mean square distance of a link's points from its posed surface [m]; 0 where not valid."""
    valid: Bool[Tensor, " n_links"]
    """Links with enough points to have a pose."""
    points: Float[Tensor, "*b n_hand 3"]
    """The multilaterated hand cloud [m]."""

    def to(self, device: torch.device | str) -> LinkPoses:
        """The same on another device."""
        return LinkPoses(*(getattr(self, name).to(device) for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class _Segments:
    """The points of each registrable link, padded to the same number."""

    links: Int[Tensor, " l"]
    index: Int[Tensor, "l p"]
    weight: Float[Tensor, "l p"]
    local: Float[Tensor, "l p 3"]


def build(
    hand_points: Float[Tensor, "*b n 3"], object_points: Float[Tensor, "*b m 3"]
) -> Float[Tensor, "*b n m"]:
    """D(R,O) of a posed hand and an object [m]."""
    # The matrix-product form of cdist loses half of the digits.
    return torch.cdist(hand_points, object_points, compute_mode="donot_use_mm_for_euclid_dist")


def decode(
    hand: Hand,
    distances: Float[Tensor, "*b n m"],
    object_points: Float[Tensor, "*b m 3"],
    config: DecodeConfig | None = None,
) -> LinkPoses:
    """Multilaterate each row and register each link; differentiable.

    Flat object clouds leave two mirrored candidates per point: each link takes those with which it fits without
    reflection, and in doubt the palm's side.
    """
    config = config or DecodeConfig()
    batch, (n, m) = distances.shape[:-2], distances.shape[-2:]
    distances, object_points = distances.reshape(-1, n, m), object_points.reshape(-1, m, 3)
    segments = _segments(hand, distances)
    both, flat = multilaterate_both(distances, object_points, config.multilateration)
    points = both[:, 0]
    if bool(flat.any()):
        second = _sides(hand, segments, both[flat].detach(), distances[flat].detach(), object_points[flat], config)
        chosen = torch.where(second[..., None], both[flat, 1], both[flat, 0])
        points = points.index_put((flat.nonzero()[:, 0],), chosen)
    local = segments.local.expand(len(points), -1, -1, -1)
    poses, residual = register(local, points[:, segments.index], segments.weight.expand(local.shape[:-1]))
    T = torch.eye(4, dtype=points.dtype, device=points.device).expand(len(points), hand.tree.n_links, 4, 4)
    T = T.index_copy(1, segments.links, poses)
    residual = points.new_zeros(T.shape[:2]).index_copy(1, segments.links, residual)
    return LinkPoses(
        T.reshape(*batch, *T.shape[1:]), residual.reshape(*batch, T.shape[1]), hand.registrable.to(points.device),
        points.reshape(*batch, n, 3),
    )


def _segments(hand: Hand, like: Tensor) -> _Segments:
    """Rows of the hand's points per registrable link; padding has weight zero."""
    links = hand.registrable.nonzero()[:, 0]
    rows = [(hand.link_index == link).nonzero()[:, 0] for link in links]
    index = torch.nn.utils.rnn.pad_sequence(rows, batch_first=True)
    lengths = torch.tensor([len(row) for row in rows])
    weight = (torch.arange(index.shape[1]) < lengths[:, None]).to(device=like.device, dtype=like.dtype)
    local = hand.link_points[index].to(like)
    return _Segments(links.to(like.device), index.to(like.device), weight, local)


def _sides(
    hand: Hand, segments: _Segments, both: Float[Tensor, "b 2 n 3"], distances: Float[Tensor, "b n m"],
    object_points: Float[Tensor, "b m 3"], config: DecodeConfig,
) -> Bool[Tensor, "b n"]:
    """For each hand point over a flat object, whether its second candidate is the right one."""
    misfit = torch.stack([distance_misfit(both[:, side], distances, object_points) for side in (0, 1)], 1)
    palm = int((segments.links == hand.palm).float().argmax())
    chosen = choose_sides(
        segments.local, segments.weight, both[:, :, segments.index], misfit[:, :, segments.index], palm, config.sides
    )
    second = chosen.new_zeros(both.shape[0], both.shape[2])
    used = segments.weight.bool()
    second[:, segments.index[used]] = chosen[:, used]
    return second


def targets(hand: Hand, poses: LinkPoses) -> tuple[Float[Tensor, "*b t 3"], Int[Tensor, " t"], Float[Tensor, "t 3"]]:
    """What the joint solver aims at: origins of the registered links, and the extra point beyond each fingertip.

    Returns:
        World positions [m], the link of each target, and its position in the link's frame [m]. A fingertip without a
        pose of its own gives no extra target.
    """
    device = poses.points.device
    links = poses.valid.nonzero()[:, 0]
    tips = torch.tensor(hand.tips, device=device)
    kept = poses.valid[tips]
    beyond = hand.tip_offsets.to(device)[kept]
    local = torch.cat([beyond.new_zeros(len(links), 3), beyond])
    index = torch.cat([links, tips[kept]])
    T = poses.T_world_link[..., index, :, :]
    return (T[..., :3, :3] @ local[..., None])[..., 0] + T[..., :3, 3], index, local


@torch.no_grad()
def solve(
    hand: Hand,
    link_poses: LinkPoses,
    q_start: Float[Tensor, "*b n_dof"] | None = None,
    config: JointSolverConfig | None = None,
) -> JointSolution:
    """Wrist pose and joints whose links come closest to decoded link poses.

    The wrist starts from the registered pose of the palm. The joints start from `q_start` or from what the relative
    poses of neighbouring links say, whichever is closer to the targets.

    Args:
        hand: The hand that was decoded.
        link_poses: From `decode`.
        q_start: The open hand that the network saw; the canonical one by default [rad or m].
        config: See JointSolverConfig.
    """
    link_poses = link_poses.to(hand.tree.origin.device)
    positions, links, local = targets(hand, link_poses)
    batch = positions.shape[:-2]
    given = hand.canonical_joints() if q_start is None else q_start.to(positions.device)
    given = torch.where(hand.movable, given, hand.rest).expand(*batch, -1)
    read = read_joints(hand.tree, link_poses.T_world_link, link_poses.valid, given)
    read = torch.where(hand.movable, read, given)
    starts = []
    for q in (given, read):
        T, error = _place_wrist(hand, link_poses, q, positions, links, local)
        starts.append((T, q, error))
    better = starts[1][2] < starts[0][2]
    T = torch.where(better[..., None, None], starts[1][0], starts[0][0])
    q = torch.where(better[..., None], starts[1][1], starts[0][1])
    return solve_joints(hand.tree, positions, links, local, T, q, movable=hand.movable, config=config)


def _place_wrist(
    hand: Hand, link_poses: LinkPoses, q: Float[Tensor, "*b n_dof"], positions: Float[Tensor, "*b t 3"],
    links: Int[Tensor, " t"], local: Float[Tensor, "t 3"],
) -> tuple[Float[Tensor, "*b 4 4"], Float[Tensor, "*b"]]:
    """Wrist pose that puts the palm where it was registered, and the mean distance from the targets there."""
    T_wrist_link = hand.tree.forward(q)
    chosen = T_wrist_link[..., links, :, :]
    points = (chosen[..., :3, :3] @ local[..., None])[..., 0] + chosen[..., :3, 3]
    if bool(link_poses.valid[hand.palm]):
        T = link_poses.T_world_link[..., hand.palm, :, :] @ torch.linalg.inv(T_wrist_link[..., hand.palm, :, :])
    else:
        T, _ = register(points, positions)
    error = points @ T[..., :3, :3].mT + T[..., None, :3, 3] - positions
    return T, error.norm(dim=-1).mean(-1)
