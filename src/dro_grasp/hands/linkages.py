"""Rods of linkages: last links that are no fingertips, because they end at a pin in another finger."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from dro_grasp.hands.anatomy import rigid_groups
from dro_grasp.hands.description.tree_reading import LinkGeometry
from dro_grasp.hands.kinematics.tree import KinematicTree

Point = Float[np.ndarray, "3"]
POSTURES = 16  # Random postures in which a pin must be where both links have it (ours)
LOOSE = 0.03
"""How far a pin may be from its mean place, as a share of its distance from the two links' own joints (ours): couplings state
some linkages only about. Of five grippers it is 0.014 at most; jaws that turn against each other about near axes have 0.09."""
TURN = 0.1  # Least angle that two links turn about their pin [rad] (ours); with none, any point would do
APART = 3e-3  # Least distance of a pin from the axes of the two links' own joints [m] (ours)
OUTSIDE = 5e-3  # Largest distance of a pin from the bounding boxes of both links [m] (ours)


@dataclass(frozen=True, eq=False)
class _End:
    """A last link of the hand, with all that is fixed to it."""

    tip: int
    link: int  # its topmost link, in whose frame the rest is
    vertices: Float[np.ndarray, "n 3"]  # corners of its shapes [m]
    anchor: Point  # a point on the axis of its joint [m]
    axis: Point

    def has(self, pin: Point) -> bool:
        """Whether a point is at this link."""
        low, high = self.vertices.min(0) - OUTSIDE, self.vertices.max(0) + OUTSIDE
        return bool(((pin >= low) & (pin <= high)).all())

    def lever(self, pin: Point) -> float:
        """Distance of a point from the axis of this link's own joint [m]."""
        return float(np.linalg.norm(np.cross(pin - self.anchor, self.axis)))


def find_rods(tree: KinematicTree, tips: Sequence[int], geometry: Sequence[LinkGeometry]) -> dict[int, int]:
    """The rods among the last links of a hand.

    Two last links that turn about one point in all postures are pinned together. The rod is the one that reaches less far
    from the link where their chains part.

    Returns:
        For each rod, which is the end of a chain as `find_tips` gives it, the tip of the finger that it is pinned to.
    """
    if tree.n_dof == len(tree.moving_names):
        return {}  # a linkage has joints that follow
    share = torch.rand(POSTURES, tree.n_dof, generator=torch.Generator().manual_seed(0))
    poses = tree.forward(tree.lower + share * (tree.upper - tree.lower)).double().numpy()
    ends, pinned = [_end(tree, tip, poses[0], geometry) for tip in tips], {}
    for i, first in enumerate(ends):
        for second in ends[i + 1:]:
            if _are_pinned(poses, first, second):
                shared = (tree.descends[first.link] & tree.descends[second.link]).nonzero()[-1, 0]
                reach = [_reach(poses, end, int(shared)) for end in (first, second)]
                rod, finger = (first, second) if reach[0] < reach[1] else (second, first)
                pinned[rod.tip] = finger.tip
    return {rod: _last(pinned, rod) for rod in pinned}


def _end(tree: KinematicTree, tip: int, poses: Float[np.ndarray, "n_links 4 4"], geometry: Sequence[LinkGeometry]) -> _End:
    group = rigid_groups(tree)
    link = group[tip]
    to_link = np.linalg.inv(poses[link])
    fixed = [(to_link @ poses[shape.link], shape.vertices) for shape in geometry if group[shape.link] == link]
    corners = np.concatenate([vertices @ T[:3, :3].T + T[:3, 3] for T, vertices in fixed])
    return _End(tip, link, corners, tree.anchor[link].double().numpy(), tree.axis[link].double().numpy())


def _are_pinned(poses: Float[np.ndarray, "k n_links 4 4"], first: _End, second: _End) -> bool:
    """Whether two links turn about one point that is at both."""
    T = np.linalg.inv(poses[:, first.link]) @ poses[:, second.link]  # second's frame in first's, in each posture
    turned = np.trace(T[0, :3, :3].T @ T[:, :3, :3], axis1=1, axis2=2)
    if np.arccos(((turned - 1) / 2).clip(-1, 1)).max() < TURN:
        return False
    # A pin p of second is where first has it, in all postures: (R_k - R_0) p = t_0 - t_k; along its axis any point will do.
    middle = second.vertices.mean(0)
    moved = T[:, :3, :3] @ middle + T[:, :3, 3]
    slopes, gaps = (T[1:, :3, :3] - T[0, :3, :3]).reshape(-1, 3), (moved[0] - moved[1:]).reshape(-1)
    pin = middle + np.linalg.lstsq(slopes, gaps, 1e-3)[0]
    places = T[:, :3, :3] @ pin + T[:, :3, 3]
    lever = min(first.lever(places.mean(0)), second.lever(pin))
    loose = np.linalg.norm(places - places.mean(0), axis=1).max() > LOOSE * lever
    return not loose and lever > APART and second.has(pin) and first.has(places.mean(0))


def _reach(poses: Float[np.ndarray, "k n_links 4 4"], end: _End, origin: int) -> float:
    """Mean over postures of the largest distance of a link's shapes from the origin of another [m]."""
    corners = end.vertices @ poses[:, end.link, :3, :3].mT + poses[:, end.link, None, :3, 3]
    return float(np.linalg.norm(corners - poses[:, None, origin, :3, 3], axis=2).max(1).mean())


def _last(pinned: dict[int, int], rod: int) -> int:
    """The finger at the end of a row of rods."""
    finger, seen = pinned[rod], {rod}
    while finger in pinned and finger not in seen:
        seen.add(finger)
        finger = pinned[finger]
    return finger
