"""A hand's anatomy, read off its tree: fingertips, palm link, rigid groups, fingers, thumb, opening signs, rods of linkages.

Nothing else in the package defines fingers and thumb: `HandBuilder` calls these functions, and other code reads the `Hand`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.errors import HandError
from dro_grasp.geometry import se3
from dro_grasp.hands.kinematics.tree import FIXED, REVOLUTE, KinematicTree

if TYPE_CHECKING:
    from dro_grasp.hands.description.tree_reading import LinkGeometry

Joints = Float[Tensor, " n_dof"]  # a value of each independent joint
JointMask = Bool[Tensor, " n_dof"]
Point = Float[Tensor, "3"]
PALM = -1
"""Finger number of links that belong to no finger: the palm, links fixed to it or above it, and links that fingers share."""
FEWEST_WITH_THUMB = 4  # Hands with fewer fingers have no thumb: their fingers all oppose each other (ours)
THUMB_CLOSING = 0.55
"""Share of the way from open to closed at which thumb opposition is measured (ours). From 0.1 to 0.75 it names the thumb of
every hand with four or five fingers, built in or among the development assets (ten hands)."""
ABOUT_AS_OPPOSED = 0.25
"""Opposition by which another finger may exceed the one that is named a thumb (ours). Of seven hands, thumbs exceed their
fingers by 0.3 to 1.0."""
MAX_FINGERS = 24  # Most fingers of a hand (ours): two hands of a humanoid, and its feet
LONGEST_FINGER = 12
"""Most joints of one finger (ours): to find which way they close, every combination of their directions is tried."""
AXIS_ALONG_PALM = 0.75  # Cosine to the palm direction above which a joint's axis points out of the palm (ours)
PARALLEL = 0.9  # Cosine above which two joint axes count as parallel (ours)


@dataclass(frozen=True)
class Finger:
    """One fingertip and the links that belong to it."""

    chain: tuple[int, ...]
    """Links from the palm (excluded) to the tip (included); a link that several fingers share is in each of their chains."""
    links: tuple[int, ...]  # links of this finger alone: those of the chain and their side links, such as a pad
    joints_to_tip: tuple[int, ...]
    """For each of `links`, the number of moving joints between it and the tip; 0 for links beside the chain."""

    @property
    def tip(self) -> int:
        """The fingertip link."""
        return self.chain[-1]


def path_to(tree: KinematicTree, link: int) -> list[int]:
    """The links from the root to this one."""
    return tree.descends[link].nonzero()[:, 0].tolist()


def rigid_groups(tree: KinematicTree) -> tuple[int, ...]:
    """For each link the topmost link that it is fixed to; links with the same one never move against each other."""
    group = list(range(tree.n_links))
    for link, parent in enumerate(tree.parent):
        if parent >= 0 and tree.kind[link] == FIXED:
            group[link] = group[parent]
    return tuple(group)


def find_tips(tree: KinematicTree, shaped: Collection[int]) -> tuple[int, ...]:
    """The deepest link with a shape below each last moving joint; HandError: there is none, or there are too many."""
    paths = [path_to(tree, link) for link in range(tree.n_links)]
    last_moving = {link: max((i for i in paths[link] if tree.kind[i] != FIXED), default=None) for link in shaped}
    tips = []
    for link in range(tree.n_links):
        solid = [i for i in sorted(shaped) if link in paths[i]]
        if solid and tree.kind[link] != FIXED and all(last_moving[i] == link for i in solid):
            tips.append(max(solid, key=lambda i: len(paths[i])))
    if not tips:
        raise HandError("no moving joint of this description carries a shape, so it has no fingertip; give its moving links a "
                        "visual or collision shape")
    if len(tips) > MAX_FINGERS:
        raise HandError(f"this description has {len(tips)} fingertips; expected at most {MAX_FINGERS}, fix the joints that "
                        "are not the hand's")
    return tuple(tips)


def find_palm_link(tree: KinematicTree, tips: Sequence[int], shaped: Collection[int]) -> int:
    """The last common ancestor of the fingertips; with one finger, the link that carries it."""
    palm = max(tree.descends[list(tips)].all(0).nonzero()[:, 0].tolist())
    while len(tips) == 1 and palm > 0 and any(tree.kind[i] != FIXED for i in path_to(tree, palm)):
        palm = tree.parent[palm]
    candidate = palm
    # If neither it nor any link fixed below it has a shape, the nearest link above that it is fixed to and that has one.
    while not set(shaped) & set(fixed_below(tree, candidate)):
        if candidate == 0 or tree.kind[candidate] != FIXED:
            return palm
        candidate = tree.parent[candidate]
    return candidate


def fixed_below(tree: KinematicTree, link: int) -> list[int]:
    """The link and all links below it that are fixed to it."""
    group, below = rigid_groups(tree), tree.descends[:, link].tolist()
    return [i for i in range(tree.n_links) if below[i] and group[i] == group[link]]


def find_fingers(
    tree: KinematicTree, tips: Sequence[int], palm: int, rods: Mapping[int, int] | None = None
) -> tuple[Finger, ...]:
    """The finger of each tip.

    A link that carries one tip, or a rod of its finger, belongs to that finger; a link that carries none belongs to the finger
    of its parent. A link fixed to the palm belongs to no finger, even if it carries one, because it does not move. `rods` are
    as `find_rods` gives them. HandError: a finger has more joints than any has.
    """
    still, below = set(fixed_below(tree, palm)), tree.descends[:, palm].tolist()
    chains = [tuple(i for i in path_to(tree, tip) if below[i] and i not in still) for tip in tips]
    carries = [set(chain).union(*(path_to(tree, rod) for rod, finger in (rods or {}).items() if finger == tip))
               for tip, chain in zip(tips, chains, strict=True)]
    owner = [PALM] * tree.n_links
    for link in range(tree.n_links):
        carried = [finger for finger, links in enumerate(carries) if link in links]
        if below[link] and link not in still:
            owner[link] = owner[tree.parent[link]] if not carried else carried[0] if len(carried) == 1 else PALM
    fingers = []
    for finger, chain in enumerate(chains):
        links = tuple(link for link, its in enumerate(owner) if its == finger)
        moving = [i for i in chain if tree.kind[i] != FIXED]
        if (free := int((tree.link_coupling[list(chain)] != 0).any(0).sum())) > LONGEST_FINGER:
            raise HandError(f"the finger that ends in link '{tree.link_names[chain[-1]]}' has {free} joints; expected at most "
                            f"{LONGEST_FINGER}, fix those that are not the finger's")
        to_tip = (sum(i > link for i in moving) if link in chain else 0 for link in links)
        fingers.append(Finger(chain, links, tuple(to_tip)))
    return tuple(fingers)


def measure_opposition(
    tree: KinematicTree, q: Joints, rate: Joints, tips: Sequence[int],
    tip_offsets: Float[Tensor, "n_tips 3"],
) -> Float[Tensor, " n_tips"]:
    """Minus the mean cosine of each fingertip's motion to the others', at joints that close at `rate`: -1 if all move alike."""
    poses, links = tree.forward(q), torch.tensor(tips, device=q.device)
    points = se3.apply(poses[links], tip_offsets)
    velocity = tree.point_jacobian(poses, points, links) @ rate
    direction = velocity / velocity.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    others = (direction.sum(0) - direction) / max(1, len(direction) - 1)
    return -(direction * others).sum(-1)


def find_thumb(opposition: Float[Tensor, " n_tips"], named: int | None = None) -> int | None:
    """The finger with the largest thumb opposition, or the one that is named so if it has about as much.

    None for hands with too few fingers to have a thumb.
    """
    if len(opposition) < FEWEST_WITH_THUMB:
        return None
    most = int(opposition.argmax())
    return most if named is None or float(opposition[most] - opposition[named]) > ABOUT_AS_OPPOSED else named


def closing_gains(
    tree: KinematicTree, q: Joints, tips: Sequence[int], tip_points: Float[Tensor, "n_tips 3"],
    targets: Sequence[Point],
) -> Joints:
    """How much nearer to the targets the upper limit of each joint brings its fingertips than the lower limit [m].

    All other joints are at `q`. Distances to several targets, which are points in the root link's frame [m], are added. The
    mean over the tips that a joint moves is taken; 0 for a joint that moves none.
    """
    links, each = list(tips), torch.arange(tree.n_dof)
    ends = q.repeat(2, tree.n_dof, 1)  # (end, joint that is moved there, joints)
    ends[0, each, each], ends[1, each, each] = tree.lower, tree.upper
    points = se3.apply(tree.forward(ends)[..., links, :, :], tip_points)
    distance = torch.stack([(points - target).norm(dim=-1) for target in targets]).sum(0)
    moved = tree.moves[links].T
    mean = (distance * moved).sum(-1) / moved.sum(-1).clamp_min(1)
    return mean[0] - mean[1]


def axes_along(tree: KinematicTree, q: Joints, direction: Point) -> JointMask:
    """The joints whose axes lie along a direction of the root link's frame and which bend no finger."""
    # A joint with a parallel one below it, or with none below it, is part of a finger's flexion.
    angular = tree.motion_axes(tree.forward(q))[1]
    moving = torch.tensor(tree.kind) != FIXED
    below = tree.descends & moving[:, None] & ~torch.eye(tree.n_links, dtype=torch.bool)
    parallel = (angular @ angular.T).abs() > PARALLEL
    along = moving & below.any(0) & ~(below & parallel).any(0) & ((angular @ direction).abs() > AXIS_ALONG_PALM)
    return (along[:, None] | (tree.link_coupling == 0)).all(0)


Place = Float[np.ndarray, "3"]
POSTURES = 16  # Random postures in which a pin must be where both links have it (ours)
LOOSE = 0.03
"""How far a pin may be from its mean place, as a share of its distance from the two links' own joints (ours): couplings state
some linkages only about. Of five grippers it is 0.014 at most; jaws that turn against each other about near axes have 0.09."""
TURN = 0.1  # Least angle that two links turn about their pin [rad] (ours); with none, any point would do
APART = 3e-3  # Least distance of a pin from the axes of the two links' own joints [m] (ours)
IN_PLACE = 2e-3  # Speed of its middle below which a last link turns in place [m/rad or m/m] (ours)
OUTSIDE = 5e-3  # Largest distance of a pin from the bounding boxes of both links [m] (ours)


@dataclass(frozen=True, eq=False)
class _End:
    """A last link of the hand, with all that is fixed to it."""

    tip: int
    link: int  # its topmost link, in whose frame the rest is
    vertices: Float[np.ndarray, "n 3"]  # corners of its shapes [m]
    anchor: Place  # a point on the axis of its joint [m]
    axis: Place | None  # its direction; None for the three hinges of a ball joint

    def has(self, pin: Place) -> bool:
        """Whether a point is at this link."""
        low, high = self.vertices.min(0) - OUTSIDE, self.vertices.max(0) + OUTSIDE
        return bool(((pin >= low) & (pin <= high)).all())

    def lever(self, pin: Place) -> float:
        """Distance of a point from the axis of this link's own joint, or from the middle of its ball [m]."""
        return float(np.linalg.norm(pin - self.anchor if self.axis is None else np.cross(pin - self.anchor, self.axis)))


def find_rods(tree: KinematicTree, tips: Sequence[int], geometry: Sequence[LinkGeometry]) -> dict[int, int]:
    """For each rod among the last links the tip of the finger that it is pinned to.

    Two last links that turn about one point in all postures are pinned together. The rod is the one that reaches less far
    from the link where their chains part.
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


def turn_in_place(tree: KinematicTree, ends: Sequence[int], geometry: Sequence[LinkGeometry]) -> set[int]:
    """Ends whose middle no joint moves, as rotors of motors within a palm; none if fewer than two others would be left."""
    places = []
    for end in ends:
        corners = np.concatenate([shape.vertices for shape in geometry if shape.link == end])
        places.append((corners.min(0) + corners.max(0)) / 2)
    poses, links = tree.forward((tree.lower + tree.upper) / 2), torch.tensor(ends)
    points = se3.apply(poses[links], torch.from_numpy(np.stack(places)).float())
    speed = tree.point_jacobian(poses, points, links).norm(dim=1).amax(1)
    found = {end for end, moved in zip(ends, speed.tolist(), strict=True) if moved < IN_PLACE}
    return found if len(ends) - len(found) > 1 else set()


def _end(tree: KinematicTree, tip: int, poses: Float[np.ndarray, "n_links 4 4"], geometry: Sequence[LinkGeometry]) -> _End:
    group = rigid_groups(tree)
    link = group[tip]
    to_link = np.linalg.inv(poses[link])
    fixed = [(to_link @ poses[shape.link], shape.vertices) for shape in geometry if group[shape.link] == link]
    corners = np.concatenate([vertices @ T[:3, :3].T + T[:3, 3] for T, vertices in fixed])
    axis = None if _is_ball(tree, link) else tree.axis[link].double().numpy()
    return _End(tip, link, corners, tree.anchor[link].double().numpy(), axis)


def _is_ball(tree: KinematicTree, link: int) -> bool:
    """Whether a link turns about three axes through one point."""
    above = tree.parent[link]
    for lower, upper in ((link, above), (above, tree.parent[above] if above >= 0 else -1)):
        if upper < 0 or not tree.kind[lower] == tree.kind[upper] == REVOLUTE:
            return False
        if not torch.equal(tree.origin[lower], torch.eye(4)) or not torch.equal(tree.anchor[lower], tree.anchor[upper]):
            return False
    return True


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
