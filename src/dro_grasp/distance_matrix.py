"""D(R,O): the distance of every hand point to every object point in the grasp, built and decoded.

Source: paper section III-C and III-D.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from dro_grasp.devices import Rows, on_device
from dro_grasp.geometry.multilateration import choose_sides, distance_misfit, multilaterate
from dro_grasp.geometry.point_clouds import point_distances
from dro_grasp.geometry.se3 import apply, apply_to_cloud, register
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.kinematics.joint_solver import JointSolution, JointSolverConfig, Targets, read_joints, solve_joints


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


@dataclass(frozen=True)
class Segments(Rows):
    """The points of each registrable link of some hands, padded to one number of links and of points.

    Links beyond a hand's own repeat its first, so that they have a pose too.
    """

    links: Int[Tensor, "b l"]
    real: Bool[Tensor, "b l"]  # false where padded
    index: Int[Tensor, "b l p"]  # rows of the hand cloud; 0 where padded
    weight: Float[Tensor, "b l p"]  # 1, or 0 where padded
    local: Float[Tensor, "b l p 3"]  # the points in their link's frame [m]
    palm: Int[Tensor, " b"]  # place of the palm among the links, or 0
    place: Int[Tensor, "b n"]  # where each point of the cloud stands in the l x p points; 0 where not in them
    kept: Bool[Tensor, "b n"]  # points that stand there

    def spread(self, count: int) -> Segments:
        """So many rows, where there is one for all."""
        return self if len(self.links) == count else Segments(
            *(getattr(self, f.name).expand(count, *getattr(self, f.name).shape[1:]) for f in dataclasses.fields(self)))

    def of_points(self, values: Float[Tensor, "b n *rest"]) -> Float[Tensor, "b l p *rest"]:
        """Values of the points of the clouds, by link."""
        return _take(values, self.index.flatten(1)).unflatten(1, self.index.shape[1:])

    def poses_of_points(self, T: Float[Tensor, "b l 4 4"]) -> Float[Tensor, "b n 4 4"]:
        """The pose of each point's link."""
        return _take(T, self.place // self.index.shape[2])


def build(hand_points: Float[Tensor, "*b n 3"], object_points: Float[Tensor, "*b m 3"]) -> Float[Tensor, "*b n m"]:
    """D(R,O) of a posed hand and an object [m]."""
    return point_distances(hand_points, object_points)


def decode(hand: Hand, distances: Float[Tensor, "*b n m"], object_points: Float[Tensor, "*b m 3"]) -> LinkPoses:
    """Multilaterate each row of D(R,O), predicted or exact [m], and register each link of the hand; differentiable.

    A flat object cloud leaves two mirrored candidates per point. Each link takes the candidates that it fits without a
    reflection; in doubt it takes the palm's side.
    """
    batch, (n, m) = distances.shape[:-2], distances.shape[-2:]
    distances, object_points = distances.reshape(-1, n, m), object_points.reshape(-1, m, 3)
    where = (distances.device, distances.dtype)
    segments = hand.kept(("segments", *where), lambda: segments_of([hand], *where))
    poses, residual, points = decode_segments(segments, distances, object_points)
    links = segments.links[0]
    T = torch.eye(4, dtype=points.dtype, device=points.device).expand(len(points), hand.tree.n_links, 4, 4)
    T = T.index_copy(1, links, poses)
    residual = points.new_zeros(T.shape[:2]).index_copy(1, links, residual)
    return LinkPoses(T.reshape(*batch, *T.shape[1:]), residual.reshape(*batch, T.shape[1]), hand.registrable.to(points.device),
                     points.reshape(*batch, n, 3))


def decode_segments(
    segments: Segments, distances: Float[Tensor, "b n m"], object_points: Float[Tensor, "b m 3"],
    among: Int[Tensor, " k"] | None = None,
) -> tuple[Float[Tensor, "b l 4 4"], Float[Tensor, "b l"], Float[Tensor, "b n 3"]]:
    """Poses of links of hands that may differ, what is left [m], and the clouds [m]; see `decode` and `LinkPoses`.

    The segments are those of each row, or of one hand for all; `among` is that of `multilaterate`.
    """
    segments = segments.spread(len(distances))
    both, flat = multilaterate(distances, object_points, among=among)
    points = both[:, 0]
    rows = flat.nonzero()[:, 0] if among is None else among
    if len(rows):
        second = _sides(segments.rows(rows), both[rows].detach(), distances[rows].detach(), object_points[rows])
        second = second & flat[rows, None]
        points = points.index_put((rows,), torch.where(second[..., None], both[rows, 1], both[rows, 0]))
    poses, residual = register(segments.local, segments.of_points(points), segments.weight)
    return poses, residual, points


def segments_of(hands: Sequence[Hand], device: torch.device, dtype: torch.dtype = torch.float32) -> Segments:
    """One row for each hand, all of one number of points."""
    links = [hand.registrable.nonzero()[:, 0].cpu() for hand in hands]
    of_points = [hand.link_index.cpu() for hand in hands]
    lists = [[(own == link).nonzero()[:, 0] for link in each] for own, each in zip(of_points, links, strict=True)]
    n_links, n_points = max(map(len, lists)), max(len(rows) for each in lists for rows in each)
    records = [_segments(hand, each, rows, n_links, n_points) for hand, each, rows in zip(hands, links, lists, strict=True)]
    stacked = Segments(*(torch.stack(values) for values in zip(*records, strict=True)))
    exact = dataclasses.replace(stacked, weight=stacked.weight.to(dtype), local=stacked.local.to(dtype))
    return on_device(exact, device)


def together(segments: Sequence[Segments]) -> Segments:
    """The rows of several, all with as many links and points."""
    return Segments(*(torch.cat([getattr(each, f.name) for each in segments]) for f in dataclasses.fields(Segments)))


def _segments(
    hand: Hand, links: Int[Tensor, " own"], rows: list[Int[Tensor, " _"]], n_links: int, n_points: int
) -> tuple[Shaped[Tensor, "..."], ...]:
    """The fields of a hand's row of `Segments`, on the CPU."""
    own, filled = torch.arange(n_links) < len(rows), rows + rows[:1] * (n_links - len(rows))
    links = torch.cat([links, links[:1].expand(n_links - len(links))])
    index, weight = torch.zeros(n_links, n_points, dtype=torch.int64), torch.zeros(n_links, n_points)
    place, kept = torch.zeros(hand.n_points, dtype=torch.int64), torch.zeros(hand.n_points, dtype=torch.bool)
    for i, row in enumerate(filled):
        index[i, : len(row)], weight[i, : len(row)] = row, 1
        if own[i]:
            place[row], kept[row] = i * n_points + torch.arange(len(row)), True
    palm = (links == hand.palm).float().argmax()
    return links, own, index, weight, hand.link_points.cpu()[index], palm, place, kept


def _take(values: Float[Tensor, "b n *rest"], index: Int[Tensor, "b k"]) -> Float[Tensor, "b k *rest"]:
    """Entries of each row by its own index."""
    return values.gather(1, index.view(*index.shape, *[1] * (values.ndim - 2)).expand(-1, -1, *values.shape[2:]))


def _sides(
    segments: Segments, both: Float[Tensor, "b 2 n 3"], distances: Float[Tensor, "b n m"],
    object_points: Float[Tensor, "b m 3"],
) -> Bool[Tensor, "b n"]:
    """Whether each hand point takes its second candidate, for grasps of flat objects."""
    candidates = torch.stack([segments.of_points(both[:, side]) for side in (0, 1)], 1)
    misfit = torch.stack([
        segments.of_points(distance_misfit(both[:, side], distances, object_points)) for side in (0, 1)], 1)
    chosen = choose_sides(segments.local, segments.weight, candidates, misfit, segments.palm)
    return chosen.flatten(1).gather(1, segments.place) & segments.kept


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
        T = link_poses.T_world_link[..., hand.palm, :, :] @ torch.linalg.inv_ex(T_wrist_link[..., hand.palm, :, :]).inverse
    else:
        T, _ = register(points, wanted.positions)
    return T, (apply_to_cloud(T, points) - wanted.positions).norm(dim=-1).mean(-1)
