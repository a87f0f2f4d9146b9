"""D(R,O): the distance of every hand point to every object point in the grasp, built and decoded.

Source: paper section III-C and III-D.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.devices import on_device
from dro_grasp.geometry.multilateration import MultilaterationConfig, SideConfig, choose_sides, distance_misfit, multilaterate
from dro_grasp.geometry.point_clouds import point_distances
from dro_grasp.geometry.se3 import apply, apply_to_cloud, register
from dro_grasp.hands.hand import Hand, Segments
from dro_grasp.hands.kinematics.joint_solver import JointSolution, JointSolverConfig, Targets, read_joints, solve_joints
from dro_grasp.kinds import Checked


@dataclass(frozen=True)
class DecodeConfig(Checked):
    """Settings of the decoding."""

    multilateration: MultilaterationConfig = field(default_factory=MultilaterationConfig)
    """Closed form and its refinement."""
    sides: SideConfig = field(default_factory=SideConfig)
    """Choice between mirrored candidates on flat clouds."""


@dataclass(frozen=True)
class LinkPoses:
    """Pose of a hand's links, decoded from D(R,O)."""

    T_world_link: Float[Tensor, "*b n_links 4 4"]
    """Pose of each link in the frame of the object points; the identity where not valid."""
    residual: Float[Tensor, "*b n_links"]
    """Root mean square distance of a link's points from its posed surface [m]; 0 where not valid."""
    valid: Bool[Tensor, " n_links"]  # links with enough points for a pose
    points: Float[Tensor, "*b n_hand 3"]  # the multilaterated hand cloud [m]

    def to(self, device: torch.device | str) -> LinkPoses:
        """The same poses on another device."""
        return on_device(self, device)


def build(hand_points: Float[Tensor, "*b n 3"], object_points: Float[Tensor, "*b m 3"]) -> Float[Tensor, "*b n m"]:
    """D(R,O) of a posed hand and an object [m]."""
    return point_distances(hand_points, object_points)


def decode(
    hand: Hand, distances: Float[Tensor, "*b n m"], object_points: Float[Tensor, "*b m 3"], config: DecodeConfig | None = None
) -> LinkPoses:
    """Multilaterate each row of D(R,O), predicted or exact [m], and register each link of the hand; differentiable.

    A flat object cloud leaves two mirrored candidates per point. Each link takes the candidates that it fits without a
    reflection; in doubt it takes the palm's side.
    """
    config = config or DecodeConfig()
    batch, (n, m) = distances.shape[:-2], distances.shape[-2:]
    distances, object_points = distances.reshape(-1, n, m), object_points.reshape(-1, m, 3)
    segments = hand.segments.to(distances)
    both, flat = multilaterate(distances, object_points, config.multilateration)
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
    return LinkPoses(T.reshape(*batch, *T.shape[1:]), residual.reshape(*batch, T.shape[1]), hand.registrable.to(points.device),
                     points.reshape(*batch, n, 3))


def _sides(
    hand: Hand, segments: Segments, both: Float[Tensor, "b 2 n 3"], distances: Float[Tensor, "b n m"],
    object_points: Float[Tensor, "b m 3"], config: DecodeConfig,
) -> Bool[Tensor, "b n"]:
    """Whether each hand point takes its second candidate, for grasps of flat objects."""
    misfit = torch.stack([distance_misfit(both[:, side], distances, object_points) for side in (0, 1)], 1)
    palm = int((segments.links == hand.palm).float().argmax())
    chosen = choose_sides(
        segments.local, segments.weight, both[:, :, segments.index], misfit[:, :, segments.index], palm, config.sides)
    second = chosen.new_zeros(both.shape[0], both.shape[2])
    used = segments.weight.bool()
    second[:, segments.index[used]] = chosen[:, used]
    return second


def targets(hand: Hand, poses: LinkPoses) -> Targets:
    """Targets of the joint solver: origins of the registered links, and the extra point beyond each registered fingertip."""
    device = poses.points.device
    links = poses.valid.nonzero()[:, 0]
    tips = torch.tensor(hand.tips, device=device)
    kept = poses.valid[tips]
    beyond = hand.tip_offsets.to(device)[kept]
    local = torch.cat([beyond.new_zeros(len(links), 3), beyond])
    index = torch.cat([links, tips[kept]])
    return Targets(apply(poses.T_world_link[..., index, :, :], local), index, local)


@torch.no_grad()
def solve(
    hand: Hand, link_poses: LinkPoses, q_start: Float[Tensor, "*b n_dof"] | None = None, config: JointSolverConfig | None = None
) -> JointSolution:
    """Wrist pose and joints whose links come closest to decoded link poses.

    The wrist starts at the registered pose of the palm. The joints start at `q_start` (default: the canonical ones) [rad or m]
    or at the values that the relative poses of neighbouring links imply, whichever is closer to the targets.
    """
    link_poses = link_poses.to(hand.tree.origin.device)
    wanted = targets(hand, link_poses)
    given = hand.canonical_joints() if q_start is None else q_start.to(wanted.positions.device)
    given = torch.where(hand.movable, given, hand.rest).expand(*wanted.positions.shape[:-2], -1)
    read = read_joints(hand.tree, link_poses.T_world_link, link_poses.valid, given)
    read = torch.where(hand.movable, read, given)
    T_given, error_given = _place_wrist(hand, link_poses, given, wanted)
    T_read, error_read = _place_wrist(hand, link_poses, read, wanted)
    better = error_read < error_given
    T = torch.where(better[..., None, None], T_read, T_given)
    q = torch.where(better[..., None], read, given)
    return solve_joints(hand.tree, wanted, T, q, hand.movable, config)


def _place_wrist(
    hand: Hand, link_poses: LinkPoses, q: Float[Tensor, "*b n_dof"], wanted: Targets
) -> tuple[Float[Tensor, "*b 4 4"], Float[Tensor, "*b"]]:
    """Wrist pose that puts the palm where it was registered, and the mean distance from the targets there [m]."""
    T_wrist_link = hand.tree.forward(q)
    points = apply(T_wrist_link[..., wanted.links, :, :], wanted.local)
    if bool(link_poses.valid[hand.palm]):
        T = link_poses.T_world_link[..., hand.palm, :, :] @ torch.linalg.inv(T_wrist_link[..., hand.palm, :, :])
    else:
        T, _ = register(points, wanted.positions)
    return T, (apply_to_cloud(T, points) - wanted.positions).norm(dim=-1).mean(-1)
