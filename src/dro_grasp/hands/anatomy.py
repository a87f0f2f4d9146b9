"""A hand's anatomy, read off its tree: fingertips, palm link, rigid groups, fingers, thumb, opening signs.

Nothing else in the package defines fingers and thumb: `HandBuilder` calls these functions, and other code reads the `Hand`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.errors import HandError
from dro_grasp.geometry import se3
from dro_grasp.hands.kinematics.tree import FIXED, KinematicTree

Joints = Float[Tensor, " n_dof"]  # a value of each independent joint
JointMask = Bool[Tensor, " n_dof"]
Point = Float[Tensor, "3"]
PALM = -1
"""Finger number of links that belong to no finger: the palm, links fixed to it or above it, and links that fingers share."""
FEWEST_WITH_THUMB = 4  # Hands with fewer fingers have no thumb: their fingers all oppose each other (ours)
THUMB_CLOSING = 0.55
"""Share of the way from open to closed at which thumb opposition is measured (ours). From 0.1 to 0.75 it names the thumb of
every hand with four or five fingers, built in or among the development assets (ten hands)."""
MOST_FINGERS = 24  # Most fingers of a hand (ours): two hands of a humanoid, and its feet
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
    """Fingertips: below each last moving joint, the deepest link with a (visual or collision) shape.

    Raises:
        HandError: No moving joint carries a shape, or too many end in one.
    """
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
    if len(tips) > MOST_FINGERS:
        raise HandError(f"this description has {len(tips)} fingertips; expected at most {MOST_FINGERS}, fix the joints that "
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
    of its parent. A link fixed to the palm belongs to no finger, even if it carries one, because it does not move.

    Args:
        rods: As `find_rods` gives them.

    Raises:
        HandError: A finger has more joints than any has.
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
    """How much each fingertip moves against the others at joints `q`, while all joints close at `rate`.

    Returns:
        Minus the mean cosine to the other tips' directions: -1 if all move alike, 1 if the others all move the opposite way.
    """
    poses, links = tree.forward(q), torch.tensor(tips, device=q.device)
    points = se3.apply(poses[links], tip_offsets)
    velocity = tree.point_jacobian(poses, points, links) @ rate
    direction = velocity / velocity.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    others = (direction.sum(0) - direction) / max(1, len(direction) - 1)
    return -(direction * others).sum(-1)


def find_thumb(opposition: Float[Tensor, " n_tips"]) -> int | None:
    """The finger with the largest thumb opposition; None for hands with too few fingers to have a thumb."""
    return None if len(opposition) < FEWEST_WITH_THUMB else int(opposition.argmax())


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
