"""From a description to a Hand, step by step. Source: paper section III-B and appendix, dataset preprocessing."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.errors import HandError, OptionError
from dro_grasp.geometry import se3
from dro_grasp.geometry.point_clouds import farthest_points, sample_surface
from dro_grasp.hands import anatomy
from dro_grasp.hands.anatomy import Finger, fixed_below, path_to
from dro_grasp.hands.closing import EARLY_CLOSINGS, MUCH_BETTER, WELL_ENCLOSED, Closing, ClosingFinder
from dro_grasp.hands.description.compiling import HAND, likely_unit
from dro_grasp.hands.description.loader import Description, named
from dro_grasp.hands.description.tree_reading import LinkGeometry
from dro_grasp.hands.doubts import filled_up
from dro_grasp.hands.hand import POINTS_PER_LINK, Hand
from dro_grasp.hands.kinematics.tree import FIXED, KinematicTree
from dro_grasp.hands.opening import ROLLING_UP, FingerMotion
from dro_grasp.hands.usable_range import in_use, sensibly_limited, without_sense

SAMPLES_PER_LINK = 512
"""Points sampled on each link before farthest point sampling. Source: appendix, robot point cloud sampling."""
NUDGE = 5e-4  # Samples this close to another shape of their link lie where the two shapes meet, not outside [m] (ours)


@dataclass(frozen=True)
class LinkSurface:
    """Samples on the links from the palm on."""

    points: Float[Tensor, "n 3"]  # in their links' frames [m]
    normals: Float[Tensor, "n 3"]  # outward unit normals, in their links' frames
    link: Int[Tensor, " n"]  # the link of each point

    def thinned(self, step: int) -> LinkSurface:
        """Every `step`-th sample."""
        return LinkSurface(self.points[::step], self.normals[::step], self.link[::step])

    def middle(self, link: int) -> Float[Tensor, "3"]:
        """Mean of a link's samples, in its frame [m]."""
        return self.points[self.link == link].mean(0)

    def posed(
        self, tree: KinematicTree, q: Float[Tensor, " n_dof"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Points [m] and normals in the root link's frame."""
        T = tree.forward(q)[self.link]
        return se3.apply(T, self.points).numpy(), se3.rotate(T[:, :3, :3], self.normals).numpy()


def sample_links(description: Description, links: list[int], seed: int) -> LinkSurface:
    """Samples of links' collision shapes as MuJoCo uses them, or else of visual ones; HandError: a link's have no area."""
    generator = torch.Generator().manual_seed(seed)
    points, normals, index = [], [], []
    for link in links:
        shapes = [g for g in description.geometry if g.link == link]
        shapes = [g for g in shapes if g.collides] or shapes
        try:
            p, n = _sample_shapes(shapes, generator)
        except ValueError as error:
            raise HandError(f"the shapes of link '{description.tree.link_names[link]}' have no area; give it a shape that is "
                            "not flat in two directions") from error
        points.append(p)
        normals.append(n)
        index.append(torch.full((len(p),), link))
    return LinkSurface(torch.cat(points), torch.cat(normals), torch.cat(index))


def _sample_shapes(shapes: list[LinkGeometry], generator: torch.Generator) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Points and normals on the outside of a union of convex shapes."""
    vertices = torch.cat([torch.tensor(s.vertices, dtype=torch.float32) for s in shapes])
    starts = np.cumsum([0, *[len(s.vertices) for s in shapes]])
    faces = torch.cat([torch.tensor(s.faces.astype(np.int64)) + int(i) for s, i in zip(shapes, starts, strict=False)])
    owner = torch.cat([torch.full((len(s.faces),), i) for i, s in enumerate(shapes)])
    points, normals, face = sample_surface(vertices, faces, 4 * SAMPLES_PER_LINK, generator)
    hidden = torch.zeros(len(points), dtype=torch.bool)
    if len(shapes) > 1:
        for i, shape in enumerate(shapes):
            others = (owner[face] != i).nonzero()[:, 0]
            hidden[others] |= _inside_convex(points[others] + NUDGE * normals[others], shape)
    seen = (~hidden).nonzero()[:, 0]
    seen = seen if len(seen) >= SAMPLES_PER_LINK // 4 else torch.arange(len(points))
    seen = seen[:SAMPLES_PER_LINK]
    return points[seen], normals[seen]


def _inside_convex(points: Float[Tensor, "n 3"], shape: LinkGeometry) -> Bool[Tensor, " n"]:
    """Whether each point lies behind all faces of a convex shape."""
    corners = torch.tensor(shape.vertices, dtype=torch.float32)[torch.tensor(shape.faces.astype(np.int64))]
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    low, high = corners.amin((0, 1)), corners.amax((0, 1))
    inside = ((points >= low) & (points <= high)).all(1)
    near = points[inside]
    height = ((near[:, None] - corners[None, :, 0]) * normal).sum(-1)
    inside[inside.clone()] = (height < -1e-4 * normal.norm(dim=-1)).all(1)
    return inside


TIP_OFFSET = 0.03  # Distance of the extra target beyond a fingertip [m]. Source: appendix, URDF file preprocessing
LARGEST_HAND = 1.5  # Largest extent, from the palm on, that a hand in metres has [m] (ours)
SMALLEST_HAND = 0.02  # Smallest extent, from the palm on, that a hand in metres has [m] (ours)
LONGEST_REACH = 0.45
"""Longest way from a hand's palm along its links to a fingertip [m] (ours). Of the built-in hands, the development assets and
thirty published ones, the longest is 0.23; arms begin at 0.5."""
LONGEST_JAW = 0.2
"""The same where there is a single fingertip [m] (ours): 0.03 to 0.05 for the jaws of SO-100, SO-101, Z1 and
Talos; the smallest arm that was seen, Koch's, has 0.34."""
MAX_NAMED = 6  # Most hands that an error names (ours)


def build_hand(description: Description, *, name: str | None = None, seed: int = 0, n_points: int = 512) -> Hand:
    """Derive everything the method needs from a description; the file's stem is the hand's name by default.

    Of the surface points, `n_points` are kept: enough for the fingertips, and no more than are sampled (SAMPLES_PER_LINK on a
    link), else OptionError. HandError: the description has no finger, no link with a surface, or a size that no hand has.
    """
    try:
        hand = HandBuilder(description, seed).build(name or description.name)
    except HandError as error:
        raise HandError(f"{description.path}: {error}") from error
    fewest = POINTS_PER_LINK * len(hand.tips)
    if not fewest <= n_points <= hand.n_points:
        raise OptionError(f"n_points is {n_points}; give an integer from {fewest} to {hand.n_points}, the points that hand "
                          f"'{hand.name}' can have")
    keep = farthest_points(hand.points(hand.canonical_joints()), n_points)
    # A fingertip that is small beside the rest may have been left out.
    missing = [tip for tip in hand.tips if not bool((hand.link_index[keep] == tip).any())]
    own = [(hand.link_index == tip).nonzero()[:POINTS_PER_LINK, 0] for tip in missing]
    keep = torch.cat([*own, keep])[:len(keep)].sort().values  # grouped by link
    return dataclasses.replace(hand, link_points=hand.link_points[keep], link_normals=hand.link_normals[keep],
                               link_index=hand.link_index[keep])


class HandBuilder:
    """The steps from a description to a hand; each is derived once, when a later one needs it."""

    def __init__(self, description: Description, seed: int = 0) -> None:
        self.description, self.tree, self.seed = description, description.tree, seed

    def build(self, name: str) -> Hand:
        """The hand with all of its samples."""
        tree, closing, surface = self.used_tree, self.closing, self.surface
        rest = self.rest.clamp(tree.lower, tree.upper)
        T = torch.linalg.inv(tree.forward(rest)[self.palm])
        to_palm = lambda p: T[:3, :3] @ torch.tensor(p, dtype=torch.float32) + T[:3, 3]  # noqa: E731
        collides = {g.link for g in self.description.geometry if g.collides}
        return Hand(
            name=name, tree=tree, link_points=surface.points, link_normals=surface.normals, link_index=surface.link,
            fingers=self.fingers, rigid_group=anatomy.rigid_groups(tree), tip_offsets=self.tip_offsets(), palm=self.palm,
            palm_centre=to_palm(closing.palm.centre),
            palm_direction=T[:3, :3] @ torch.tensor(closing.palm.direction, dtype=torch.float32),
            grasp_centre=to_palm(closing.palm.grasp_centre), opening_signs=closing.opening_signs,
            open_ends=closing.open_ends.clamp(tree.lower, tree.upper), movable=self.movable, rest=rest,
            abduction=closing.abduction,
            contact_links=tuple(i for i in self.links if i in collides),
            sha256=self.description.sha256, description=self.description,
        ).with_thumb()

    @cached_property
    def shaped(self) -> list[int]:
        """Links with a visual or collision shape."""
        shaped = sorted({g.link for g in self.description.geometry})
        if not shaped:
            raise HandError("no link has a visual or collision shape, so the hand can touch nothing; give its links shapes")
        return shaped

    @cached_property
    def ends(self) -> tuple[int, ...]:
        """Fingertip links, and the ends of linkages' rods."""
        try:
            ends = anatomy.find_tips(self.tree, self.shaped)
            rotors = anatomy.turn_in_place(self.tree, ends, self.description.geometry)
            return tuple(end for end in ends if end not in rotors)
        except HandError as error:
            lost = [note.text for note in self.description.notes if note.level == "warning"]
            raise HandError("; ".join([str(error), *lost[:3]])) from error

    @cached_property
    def rods(self) -> dict[int, int]:
        """For each end of a linkage's rod the fingertip that it is pinned to."""
        return anatomy.find_rods(self.tree, self.ends, self.description.geometry)

    @cached_property
    def tips(self) -> tuple[int, ...]:
        """Fingertip links."""
        return tuple(end for end in self.ends if end not in self.rods)

    @cached_property
    def palm(self) -> int:
        """The palm link."""
        palm = anatomy.find_palm_link(self.tree, self.tips, self.shaped)
        if self.description.link is None:
            require_one_hand(self.tree, self.tips, palm, self.description.path.name)
        return palm

    @cached_property
    def fingers(self) -> tuple[Finger, ...]:
        """One for each fingertip."""
        return anatomy.find_fingers(self.tree, self.tips, self.palm, self.rods)

    @cached_property
    def links(self) -> list[int]:
        """The palm and all links below it."""
        return self.tree.descends[:, self.palm].nonzero()[:, 0].tolist()

    @cached_property
    def movable(self) -> Bool[Tensor, " n_dof"]:
        """The joints that do not move the palm itself."""
        return self.tree.link_coupling[path_to(self.tree, self.palm)].abs().sum(0) == 0

    @cached_property
    def rest(self) -> Float[Tensor, " n_dof"]:
        """Joints at zero, or at the nearest limit [rad or m]."""
        return torch.zeros(self.tree.n_dof).clamp(self.tree.lower, self.tree.upper)

    @cached_property
    def surface(self) -> LinkSurface:
        """Dense samples from the palm on."""
        surface = sample_links(self.description, [link for link in self.links if link in self.shaped], self.seed)
        size = float(np.ptp(surface.posed(self.tree, self.rest)[0], axis=0).max())
        if size > LARGEST_HAND:
            whole, (unit, scale) = named(self.description.path.name, "LINK"), likely_unit(size, HAND)
            raise HandError(f"the hand is {size:.3g} m large, which looks like {unit}; expected metres: scale its shapes by "
                            f'{scale:g}, meshes by scale="{scale:g} {scale:g} {scale:g}" in <mesh>, and its origins if '
                            f"they are too large as well; or, if this is a whole robot, give its hand: {whole}")
        if size < SMALLEST_HAND:
            raise HandError(f"the hand is {size:.3g} m large, which looks like another unit than metres; expected "
                            f"{SMALLEST_HAND} to {LARGEST_HAND} m: scale its origins, shapes and meshes")
        return surface

    @cached_property
    def coarse(self) -> LinkSurface:
        """A quarter of the samples, enough to find the palm and the opening signs."""
        return self.surface.thinned(4)

    @cached_property
    def on_palm(self) -> Bool[np.ndarray, " n"]:
        """The coarse samples on the palm; all of them if it has none."""
        mask = np.isin(self.coarse.link.numpy(), fixed_below(self.tree, self.palm))
        return mask if mask.any() else np.ones(len(mask), bool)

    @cached_property
    def motion(self) -> FingerMotion:
        """Fingertips as functions of joints, with sensible limits."""
        middles = torch.stack([self.coarse.middle(finger.tip) for finger in self.fingers])
        motion = FingerMotion(self.tree, self.fingers, middles)
        return dataclasses.replace(motion, tree=sensibly_limited(motion, self.rest, self.movable, self.stated))

    @cached_property
    def used_tree(self) -> KinematicTree:
        """The tree, with limits of joints that state none that make sense where they are of use."""
        wide = without_sense(self.tree, self.movable)
        rest = self.rest.clamp(self.motion.tree.lower, self.motion.tree.upper)
        return in_use(self.motion, wide, self.closing, rest, self.coarse.posed(self.tree, rest)[0][self.on_palm])

    @cached_property
    def closing(self) -> Closing:
        """From where and to where the joints close, and the palm."""
        finder = self.finder
        try:
            found = finder.find()
        except HandError as error:
            hulls = [f"{note.subject}: {note.text}" for note in filled_up(self.description)]
            raise HandError("; ".join([str(error), *hulls])) from error
        # Half closed, a hand whose limits let its fingers roll up encloses little; it is examined earlier then.
        if found.palm.score <= WELL_ENCLOSED and finder.motion.bend(finder.tree.lower, finder.tree.upper) >= ROLLING_UP:
            with contextlib.suppress(HandError):  # nothing is enclosed so early
                early = dataclasses.replace(finder, closings=EARLY_CLOSINGS).find()
                return early if early.palm.score > found.palm.score + MUCH_BETTER else found
        return found

    @cached_property
    def finder(self) -> ClosingFinder:
        """What the closing is derived from."""
        rest = self.rest.clamp(self.motion.tree.lower, self.motion.tree.upper)
        return ClosingFinder(self.motion.tree, rest, self.movable, self.stated, self.stated_ways, self.fingers, self.coarse,
                             self.on_palm, sideways=torch.zeros_like(self.movable))

    @cached_property
    def stated_ways(self) -> Float[Tensor, " n_dof"]:
        """+1 for joints that close by increasing, as the closed posture says that the file states, -1 for others; 0: unsaid."""
        closed = torch.tensor([self.description.closed_posture.get(name, float("nan")) for name in self.tree.joint_names])
        start = torch.where(self.stated.isnan(), (self.tree.lower + self.tree.upper) / 2, self.stated)
        return torch.where(self.movable, (closed - start).nan_to_num(0.0).sign(), 0.0)

    @cached_property
    def stated(self) -> Float[Tensor, " n_dof"]:
        """The open posture that the file states [rad or m]; NaN where it states none."""
        values = [self.description.open_posture.get(name, float("nan")) for name in self.tree.joint_names]
        stated = torch.tensor(values).clamp(self.tree.lower, self.tree.upper)
        return torch.where(self.movable, stated, torch.nan)

    def tip_offsets(self) -> Float[Tensor, "n_tips 3"]:
        """Points beyond the fingertips, in the direction from the last joint through the middle of the tip's surface [m]."""
        poses, offsets = self.tree.forward(self.rest), []
        for tip in self.tips:
            last = max(i for i in path_to(self.tree, tip) if self.tree.kind[i] != FIXED)
            T_tip_last = torch.linalg.inv(poses[tip]) @ poses[last]
            middle = self.surface.middle(tip)
            along = middle - (T_tip_last[:3, 3] + T_tip_last[:3, :3] @ self.tree.anchor[last])
            offsets.append(middle + TIP_OFFSET * along / along.norm().clamp(min=1e-6))
        return torch.stack(offsets)


def reach(tree: KinematicTree, above: int, below: int) -> float:
    """The way along the links from one down to another [m]."""
    links = sorted(set(path_to(tree, below)) - set(path_to(tree, above)))
    return float(tree.origin[links, :3, 3].norm(dim=-1).sum())


def find_hands(tree: KinematicTree, tips: Sequence[int]) -> list[int]:
    """The palms of a whole robot: the links all of whose fingertips, two at least, are near, and above which that ends."""
    found: list[int] = []
    for link in range(tree.n_links):
        own = [tip for tip in tips if tip != link and bool(tree.descends[tip, link])]
        together = len(own) > 1 and max(tree.descends[own].all(0).nonzero()[:, 0].tolist()) == link
        if together and not tree.descends[link, found].any() and all(reach(tree, link, tip) < LONGEST_REACH for tip in own):
            found.append(link)
    return found


def require_one_hand(tree: KinematicTree, tips: Sequence[int], palm: int, file: str) -> None:
    """Refuse a robot with several hands, one beside other moving ends, or arms alone; the HandError says how to ask for one."""
    hands = find_hands(tree, tips)
    if hands and not bool(tree.descends[list(tips), hands[0]].all()):
        more = ", ..." if len(hands) > MAX_NAMED else ""
        given = ", ".join(named(file, tree.link_names[hand]) for hand in hands[:MAX_NAMED])
        raise HandError(f"this is a whole robot; give the hand that you want: {given}{more}")
    longest = LONGEST_REACH if len(tips) > 1 else LONGEST_JAW
    far = [tip for tip in tips if reach(tree, palm, tip) > longest]
    if far and not hands:
        carriers = [tree.parent[max(link for link in path_to(tree, tip) if tree.kind[link] != FIXED)] for tip in far]
        begin = [named(file, tree.link_names[link]) for link in dict.fromkeys([palm, *carriers[:MAX_NAMED]])]
        way, what = reach(tree, palm, far[0]), "this is an arm" if len(tips) == 1 else "these are arms or legs"
        unit, scale = likely_unit(way, HAND)
        guess = f"so {what}" if way <= LARGEST_HAND else (
            f"which looks like {unit}: scale its origins, shapes and meshes by {scale:g}; or {what}")
        raise HandError(f"its fingertip '{tree.link_names[far[0]]}' is {way:.2g} m of links away from "
                        f"'{tree.link_names[palm]}', {guess}; name the link at which the hand begins: {begin[0]} for all of it"
                        + (f", or for example {' or '.join(begin[1:])}" if begin[1:] else ""))
