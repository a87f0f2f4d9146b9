"""How a hand closes: the palm and the direction it faces, and from which end of each joint's range to which it closes there.

The half-closed hand encloses a volume. An object would sit in the largest ball that palm and fingers surround there: its
centre is the grasp centre, and the palm direction points from the palm's surface to it. Where one jaw moves, as in many small
grippers, the palm's link is both the block between the jaws and the jaw that stands still. Only with the two told apart is the
palm direction the one in which the jaws point.

The limits of most hands say how far fingers open: as far as they go. A finger whose limits let it fold back behind the palm is
open where it spans the most.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, KDTree, QhullError
from torch import Tensor

from dro_grasp.errors import HandError
from dro_grasp.hands.anatomy import FEWEST_WITH_THUMB, PALM, Finger, JointMask, Joints, Point, axes_along, closing_gains
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.kinematics.tree import KinematicTree
from dro_grasp.hands.opening import BOTH_WAYS, EXACT, FAR_BACK, ONE_WAY, Curl, FingerMotion, Line

if TYPE_CHECKING:
    from dro_grasp.hands.build import LinkSurface

Place = Float[np.ndarray, "3"]
Points = Float[np.ndarray, "n 3"]
Mask = Bool[np.ndarray, " n"]
GRID_SPACING = 0.008  # Spacing of candidate ball centres [m] (ours)
GRID_CELLS = 200_000  # Number of them in a hand's box beyond which they lie farther apart (ours): that of a box of half a metre
CLOSINGS = (0.35, 0.5, 0.65)  # Shares of the way from open to closed at which the hand is examined (ours)
EARLY_CLOSINGS = (0.1, 0.2, *CLOSINGS)
"""Shares of the way from open to closed at which hands whose fingers may roll up are examined as well (ours)."""
WELL_ENCLOSED = 0.04  # Score of a palm above which no earlier closing is looked at [m] (ours)
MUCH_BETTER = 0.01
"""How much better a palm must be for that it is found at an earlier closing [m] (ours). Grippers with such limits gain 0.014 to
0.02, D'Claw 0.003."""
STAND_IN = 64  # Points that stand for a palm without shape (ours)
FACE_POINTS = 16  # Number of palm samples nearest to the grasp centre that make up the palm's inner face (ours)
NOTHING_ENCLOSED = ("palm and fingers of the half-closed hand enclose no space, so nothing can be grasped; check the origins, "
                    "axes and limits of its joints")
"""Error message."""
LARGEST_BALL = 0.05  # Radius beyond which a larger empty ball is no better [m] (ours)
NEARLY_CLOSED = ((0.79, 0.8), (0.34, 0.35))
"""Shares of the way from open to closed between which the jaw is looked for (ours). Closed all the way, jaws often overlap, and
a finger of several joints curls past the jaw."""
SLIDING = 0.1  # Difference in speed along a finger, as a share of its mean, below which it slides rather than turns (ours)
KNUCKLE = 0.25  # Share of the finger beside which the jaw has not begun (ours)
LEAST_LENGTH = 0.3  # Length of a jaw, as a share of the finger's, below which the palm has none (ours)
LARGEST_WIDTH = 2.5  # Width of a jaw, as a multiple of the finger's, above which it is a flat palm (ours)


@dataclass(frozen=True)
class Palm:
    """The palm in some frame."""

    centre: Place  # middle of the inner face [m]
    direction: Place  # unit vector towards the object
    grasp_centre: Place  # centre of the enclosed ball [m]
    score: float  # how well palm and fingers surround the ball [m]; higher is better


def find_palm(
    palm_points: Points, palm_normals: Points, fingers: list[Float[np.ndarray, "_ 3"]], ahead: Place | None = None
) -> Palm:
    """The palm before which surface points [m] of palm and fingers enclose a ball best, on the side that is `ahead` if given.

    HandError: they enclose nothing.
    """
    everything = np.concatenate([palm_points, *fingers])
    try:
        hull = ConvexHull(everything)
    except QhullError as error:
        raise HandError(NOTHING_ENCLOSED) from error
    low, high = everything.min(0), everything.max(0)
    spacing = max(GRID_SPACING, float(np.prod(high - low) / GRID_CELLS) ** (1 / 3))
    axes = [np.arange(a, b, spacing) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    planes = np.unique(hull.equations.round(6), axis=0)
    for some in np.array_split(planes, math.ceil(len(planes) / 32)):  # most centres fall to the first planes
        grid = grid[(grid @ some[:, :3].T < -some[:, 3]).all(1)]
    tree = KDTree(palm_points)
    to_palm, nearest = map(np.asarray, tree.query(grid))
    outside = ((grid - palm_points[nearest]) * palm_normals[nearest]).sum(1) > 0.7 * to_palm
    if ahead is not None:
        outside &= (palm_normals @ ahead > AHEAD)[nearest]
    grid, to_palm, nearest = grid[outside], to_palm[outside], nearest[outside]
    if not len(grid):
        raise HandError(NOTHING_ENCLOSED)
    to_fingers = np.stack([KDTree(f).query(grid)[0] for f in fingers], 1)
    radius = np.minimum(np.minimum(to_palm, to_fingers.min(1)), LARGEST_BALL)
    # A ball that touches everything around it scores its radius; gaps to palm and fingers count against it.
    gaps = (to_palm - radius + (to_fingers - radius[:, None]).mean(1)) / 2
    score = radius - 0.5 * gaps
    best = score > score.max() - 0.002
    centre = grid[best].mean(0)
    return Palm(*_face_towards(palm_points, palm_normals, centre), centre, float(score.max()))


def _face_towards(points: Points, normals: Points, target: Place) -> tuple[Place, Place]:
    """Middle [m] and mean normal of the part of the palm's surface that is nearest to a point in front of it."""
    offset = target - points
    distance = np.linalg.norm(offset, axis=1)
    facing = (offset * normals).sum(1) > 0.5 * distance
    facing = facing if facing.any() else np.ones(len(points), bool)
    nearest = np.flatnonzero(facing)[np.argsort(distance[facing])[:FACE_POINTS]]
    normal = normals[nearest].mean(0)
    return points[nearest].mean(0), normal / np.linalg.norm(normal)


@dataclass(frozen=True)
class FixedJaw:
    """The part of a palm that a finger closes on."""

    mask: Mask  # the points of the hand that are on it
    direction: Place  # unit vector from the palm to its end, along the nearly closed finger
    length: float  # how far it extends from there [m]


def find_fixed_jaw(before: Points, points: Points, on_palm: Mask, on_finger: Mask) -> FixedJaw | None:
    """The jaw that a nearly closed finger approaches; None if the palm has no such part, as a flat palm or a block alone.

    Surface points are those when it is nearly closed and those a little before [m].
    """
    if not on_palm.any() or (on_palm & on_finger).any():
        return None
    palm, finger, motion = points[on_palm], points[on_finger], (points - before)[on_finger]
    if not (closing := _unit(motion.mean(0))).any():
        return None
    outwards = _faster(finger, np.linalg.norm(motion, axis=1))
    outwards = finger.mean(0) - palm.mean(0) if outwards is None else outwards
    outwards = _unit(outwards - (outwards @ closing) * closing)
    across = np.cross(outwards, closing)
    along_palm, along_finger = palm @ outwards, finger @ outwards
    outer_half = finger[along_finger > along_finger.mean()]
    passed = palm @ closing < outer_half.mean(0) @ closing
    begin = along_palm[passed].max(initial=along_finger.min() + KNUCKLE * np.ptp(along_finger))
    length, mask = float(along_palm.max() - begin), on_palm & (points @ outwards > begin)
    if length < LEAST_LENGTH * np.ptp(along_finger) or np.array_equal(mask, on_palm):
        return None
    flat = np.ptp(points[mask] @ across) > LARGEST_WIDTH * np.ptp(finger @ across)
    return None if flat else FixedJaw(mask, outwards, length)


def fixed_jaw_of(hand: Hand) -> FixedJaw | None:
    """The part of the palm that a hand's single finger closes on; None of several fingers."""
    palm, finger = ((hand.finger_of_link[hand.link_index] == part).numpy() for part in (PALM, 0))
    return _single_jaw(hand.fingers, lambda share: hand.points(hand.canonical_joints(1 - share)).numpy(), palm, finger)


def _single_jaw(
    fingers: Sequence[Finger], points: Callable[[float], Points], on_palm: Mask, on_finger: Mask
) -> FixedJaw | None:
    """The jaw of points where the hand is closed by a share, of a hand with one finger; None of several fingers."""
    if len(fingers) != 1:
        return None
    for shares in NEARLY_CLOSED[: 1 + (len(fingers[0].chain) > 1)]:
        before, after = map(points, shares)
        if (jaw := find_fixed_jaw(before, after, on_palm, on_finger)) is not None:
            return jaw
    return None


def _faster(points: Float[np.ndarray, "m 3"], speed: Float[np.ndarray, " m"]) -> Place | None:
    """The direction in which points move faster, from the hinge outwards; None if all move alike."""
    offset = points - points.mean(0)
    gradient = np.linalg.lstsq(offset, speed - speed.mean())[0]
    return gradient if np.ptp(offset @ gradient) > SLIDING * speed.mean() else None


def _unit(vector: Place) -> Place:
    """The vector's direction; zero if it has none."""
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


REFINEMENTS = 3  # Rounds in which opening signs and palm are derived from each other (ours)
AHEAD = 0.5  # Cosine between a palm's direction and the side to which fingers close from which on it faces that side (ours)
MOST_UNSURE = 6  # Most fingers that bend as far back as forth of which all combinations of sides are tried (ours)
FACING = 0.8
"""Cosine to the direction in which fingers begin to close from which on a palm faces it (ours). Of 16 hands: 0.86 to 1."""
TOGETHER = 0.6  # Length of the mean direction in which fingers close from which on they close alike (ours)
LEVEL_FINGERS = 3  # Fewest fingers that show so where the palm faces (ours)
CLOSED_SHARE = 0.25  # Share of its range next to its closed end in which no knuckle is open (ours)
DECIDES = 0.3
"""Share of a finger's part in how much nearer fingertips come to each other from which on it tells where it closes (ours)."""
NEARER = 1e-4  # Least amount of that, a sum of squared distances [m^2] (ours): one centimetre
PATH = 65  # Postures on the way from closed to open at which a hand is examined (ours)
AT_LIMIT = 0.1  # Distance to a limit, as a share of the range, within which a joint is at this limit (ours)


@dataclass(frozen=True)
class Closing:
    """The closing of a hand: ends of each joint, and the palm."""

    opening_signs: Joints  # as in `Hand`
    open_ends: Joints  # as in `Hand` [rad or m]
    abduction: JointMask  # as in `Hand`
    palm: Palm  # in the root link's frame


@dataclass(frozen=True)
class ClosingFinder:
    """What the closing of a hand is derived from."""

    tree: KinematicTree
    rest: Joints  # as in `Hand`
    movable: JointMask  # as in `Hand`
    stated: Joints  # the open posture that the hand's file states [rad or m]; NaN for joints of which it says nothing
    stated_ways: Joints  # +1 for joints that close by increasing, as it states, -1 for others, 0 if it says nothing
    fingers: tuple[Finger, ...]
    coarse: LinkSurface  # some samples of every link from the palm on
    on_palm: Bool[np.ndarray, " n"]  # the samples on the palm
    sideways: JointMask  # joints that are taken to spread the fingers, whatever their axes
    closings: tuple[float, ...] = CLOSINGS  # shares of the way from open to closed at which the hand is examined

    def find(self) -> Closing:
        """The closing between the limits, or from where fingers that fold or bend back beyond it are straight."""
        found = self.between_limits()
        if self.fixed_jaw(found.open_ends, found.opening_signs, found.abduction) is not None:
            return found
        if (sideless := self.without_side(found)) is not None:
            return sideless
        folded = self.folded(found)
        return self.unfolded(found, folded) if bool(folded.any()) else found

    def unfolded(self, found: Closing, folded: Bool[Tensor, " n_tips"]) -> Closing:
        """The closing of a hand some of whose fingers fold back: these open straight, and at their knuckles the widest."""
        tree, of_folded = self.tree, self.tree.moves[self.motion.links][folded].any(0)
        other = dataclasses.replace(self, sideways=self.spreading(found).sideways & of_folded)
        abduction = (found.abduction | other.sideways) & self.movable
        cut = of_folded & other.bending(abduction)
        straight = torch.where(cut, self.outstretched, self.start)
        knuckles, opening = self.motion.knuckle_joints(cut), found.opening_signs
        room = CLOSED_SHARE * (tree.upper - tree.lower)  # a finger that lies across the palm is not open
        half = dataclasses.replace(tree, lower=torch.where(opening > 0, tree.lower + room, tree.lower),
                                   upper=torch.where(opening < 0, tree.upper - room, tree.upper))
        axis = Line(_tensor(found.palm.centre), _tensor(found.palm.direction))
        start = torch.where(knuckles, straight.clamp(half.lower, half.upper), straight)
        widest = dataclasses.replace(self.motion, tree=half).widest(axis, start, knuckles)
        return other.narrowed(cut, widest, opening)

    def spreading(self, found: Closing) -> ClosingFinder:
        """The same, but joints that move fingers sideways are taken to spread them."""
        return dataclasses.replace(self, sideways=self.motion.sideways(self.rest, self.movable, _tensor(found.palm.direction)))

    def without_side(self, found: Closing) -> Closing | None:
        """The closing of a hand whose limits do not tell on which side its palm is; None of others.

        These are flat hands of which every last joint, but for a thumb's, bends as far back as forth.
        """
        other = self.spreading(found)
        bends = other.bending(found.abduction)
        # No posture of a finger of one joint is straighter than another: its zero is all there is to go by.
        alone = (self.tree.moves[self.motion.links] & bends)[self.of_one_joint(bends)].any(0)
        straight = self.motion.straightest(torch.where(alone, self.start, (self.tree.lower + self.tree.upper) / 2), bends)
        last = [int(joints.nonzero()[-1, 0]) for finger in self.fingers
                if bool((joints := self.tree.moves[finger.tip] & self.movable).any())]
        enough = len(last) - (len(last) >= FEWEST_WITH_THUMB)
        both = other.both_ways(straight, found.abduction)[last]
        if not 0 < enough <= min(int(both.sum()), int(self.motion.level(straight).sum())):
            return None
        signs, palm = other.better_side(straight)
        abduction = other.out_of_palm(straight, signs, palm) & self.movable
        closing = other.straight_about(Closing(signs, straight, abduction, palm), everywhere=True)
        if closing is None or float(_tensor(closing.palm.direction) @ _tensor(palm.direction)) > FACING:
            return closing
        return dataclasses.replace(closing, palm=palm)  # its thumb, which opens otherwise now, would turn it

    def straight_about(self, found: Closing, everywhere: bool = False) -> Closing | None:
        """The closing about a palm of fingers that open straight, everywhere or where they bend both ways; None: nowhere."""
        abduction = (found.abduction | self.sideways) & self.movable
        bends, palm = self.bending(abduction), found.palm
        axis = Line(_tensor(palm.centre), _tensor(palm.direction))
        straight = self.motion.straightest(self.start, bends)
        straight = self.motion.widest(axis, straight, self.motion.knuckle_joints(bends) & self.motion.hinges(straight))
        cut = bends if everywhere else self.both_ways(straight, abduction)
        if not bool(cut.any()):
            return None
        signs = self.signs_from(straight, found.opening_signs, abduction, _tensor(palm.grasp_centre))
        return self.narrowed(cut, straight, signs)

    def bending(self, abduction: JointMask) -> JointMask:
        """Joints that may bend a finger, and whose open posture no file states."""
        return self.movable & ~abduction & ~self.sideways & self.stated.isnan()

    def both_ways(self, straight: Joints, abduction: JointMask) -> JointMask:
        """Joints that bend a finger far, and as far back as forth from where it is straight."""
        # One that turns a finger about something else than its other joints, as a thumb's first, does not bend it.
        tree = self.tree
        ways = torch.stack([straight - tree.lower, tree.upper - straight])
        back, forth = ways.amin(0), ways.amax(0)
        return self.bending(abduction) & self.motion.hinges(straight) & (back > FAR_BACK) & (back >= BOTH_WAYS * forth)

    @cached_property
    def start(self) -> Joints:
        """Joints at rest, or as the file states them [rad or m]."""
        return torch.where(self.stated.isnan(), self.rest, self.stated)

    def between_limits(self) -> Closing:
        """Opening signs, abduction joints and palm, refined together."""
        # A joint opens towards the limit at which its fingertips are farther from the grasp centre and from the palm, while
        # all other joints are at rest or half closed. The distance to the grasp centre tells closing from spreading; curled
        # fingers pass it, but come nearer to the palm all the way.
        tree, n_dof = self.tree, self.tree.n_dof
        centre = _tensor(self.coarse.posed(tree, (tree.lower + tree.upper) / 2)[0].mean(0))
        signs, abduction = -torch.ones(n_dof), torch.zeros(n_dof, dtype=torch.bool)
        out_of_palm, palm = abduction, None
        for _ in range(REFINEMENTS):
            before = torch.cat([signs, abduction])
            signs, abduction = self.signs_at_limits(signs, abduction, out_of_palm, centre), out_of_palm
            if palm is None or not torch.equal(before, torch.cat([signs, abduction])):
                palm = self.examine(self.opened(signs), signs, abduction)
            centre = _tensor(palm.grasp_centre)
            out_of_palm = self.out_of_palm(self.opened(signs), signs, palm)
        assert palm is not None
        return Closing(signs, self.opened(signs), abduction & self.movable, palm)

    def narrowed(self, cut: JointMask, widest: Joints, signs: Joints) -> Closing:
        """The closing of a hand some of whose joints do not open beyond the widest posture."""
        lower = torch.where(cut & (signs < 0), widest, self.tree.lower)
        upper = torch.where(cut & (signs > 0), widest, self.tree.upper)
        tree = dataclasses.replace(self.tree, lower=lower, upper=upper)
        return dataclasses.replace(self, tree=tree, stated=torch.where(cut, widest, self.stated)).between_limits()

    def better_side(self, spread: Joints) -> tuple[Joints, Palm]:
        """Opening signs of a hand that closes from here to the side where it encloses a ball best, and the palm there."""
        velocity, still = self.motion.velocities(spread), torch.zeros_like(self.movable)
        normal, sides = self.motion.way_of_bending(spread), []
        for side in (normal, -normal):
            signs = self.away_from_limits(spread, torch.where((velocity * side[:, None]).sum((0, 1)) >= 0, -1.0, 1.0))
            with contextlib.suppress(HandError):
                palm = self.examine(spread, signs, still)
                ahead = float(_tensor(palm.direction) @ side) > AHEAD
                sides.append((ahead, palm.score + self.lean(side), side, signs, palm))
        if not sides:
            raise HandError(NOTHING_ENCLOSED)
        _, _, side, signs, palm = max(sides, key=lambda found: found[:2])
        # Where a thumb beside the fingers encloses more with them than the palm does, the palm still faces where they bend.
        facing = float(_tensor(palm.direction) @ side) > FACING
        return signs, palm if facing else self.examine(spread, signs, still, side.double().numpy())

    def lean(self, side: Point) -> float:
        """How far the fingers of the hand at rest lean to one side of the palm, and a thumb stands out there [m]."""
        height = self.motion.tips(self.rest) @ side
        curl = height - self.motion.knuckles(self.rest, self.movable) @ side
        aside = (height - height.median()).sum() if len(self.fingers) >= FEWEST_WITH_THUMB else 0.0
        return float(curl.sum() + aside)

    def signs_at_limits(self, signs: Joints, abduction: JointMask, spreads: JointMask, centre: Point) -> Joints:
        """Opening signs by what each joint does from limit to limit, with the others at rest or, by these signs, half closed.

        Abduction joints are at rest when the hand is half closed, `spreads` close nothing; `centre` is the grasp centre [m].
        """
        bases = (self.rest, self.posture(self.opened(signs), signs, abduction, 0.5))
        tips, targets = (self.motion.links, self.motion.tip_points), (centre, self.palm_middle)
        gains = self.curled(torch.stack([closing_gains(self.tree, q, *tips, targets) for q in bases]).sum(0))
        signs = torch.where((gains >= 0) | spreads, -1.0, 1.0)
        # A single finger closes on the jaw that is part of the palm, if there is one on either side.
        jaw, other = (self.fixed_jaw(self.opened(way), way, abduction) for way in (signs, -signs))
        signs = signs if other is None or (jaw and jaw.length >= other.length) else -signs
        # A joint whose stated open posture is a limit opens towards it.
        signs = torch.where(self.stated.isnan(), signs, self.away_from_limits(self.stated, signs))
        return torch.where(self.stated_ways == 0, signs, -self.stated_ways)

    def signs_from(self, widest: Joints, signs: Joints, abduction: JointMask, centre: Point) -> Joints:
        """Opening signs of joints that start from the widest posture: those that close each fingertip on the grasp centre."""
        # The joints of a finger are decided together, because a thumb closes on the other fingers only as a whole.
        for finger in self.fingers:
            joints = (self.tree.moves[finger.tip] & self.movable & ~abduction).nonzero()[:, 0]
            if not len(joints):  # it only spreads
                continue
            choices = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * len(joints)).reshape(-1, len(joints))
            tried = signs.repeat(len(choices), 1)
            tried[:, joints] = choices
            tried = self.away_from_limits(widest, torch.stack([-self.curled(-row) for row in tried]).unique(dim=0))
            postures = torch.cat([self.posture(widest, tried, abduction, share) for share in CLOSINGS])
            distance = (self.motion.tips(postures) - centre).norm(dim=-1).sum(-1).unflatten(0, (len(CLOSINGS), -1)).sum(0)
            signs = tried[int(distance.argmin())]
        return signs

    def curled(self, gains: Joints) -> Joints:
        """What each joint gains by increasing, but hinges of one finger close together, to the side to which it curls."""
        for curl, side in zip(*self.sides, strict=True):
            total = side if side else float((gains * curl.ways).sum())
            gains = torch.where(curl.ways != 0, curl.ways * total, gains)
        return gains

    @cached_property
    def sweep(self) -> Place | None:
        """The direction in which straight fingers begin to close [unit vector], if they do it alike."""
        curls, sides = self.sides
        closing = torch.stack([curl.ways * side for curl, side in zip(curls, sides, strict=True)])
        straight = self.wholly_straight
        moved = (self.motion.velocities(straight) * closing[:, None]).sum(-1)[torch.tensor(sides) != 0]
        way = torch.nn.functional.normalize(moved, dim=-1).mean(0) if len(moved) else torch.zeros(3)
        return _unit(way.double().numpy()) if len(moved) >= LEVEL_FINGERS and float(way.norm()) > TOGETHER else None

    @cached_property
    def straight(self) -> Joints:
        """Straight fingers [rad or m]."""
        bends = self.movable & ~self.sideways & self.stated.isnan()
        return self.motion.straight(self.start, bends & ~self.motion.whole(bends)) if bool(bends.any()) else self.start

    @cached_property
    def outstretched(self) -> Joints:
        """Fingers that reach the farthest from their knuckles [rad or m]."""
        bends = self.movable & ~self.sideways & self.stated.isnan()
        alone = bends & ~self.motion.whole(bends) if bool(bends.any()) else bends
        return self.motion.straightest(self.start, alone, EXACT) if bool(alone.any()) else self.start

    @cached_property
    def wholly_straight(self) -> Joints:
        """Straight fingers, joints that drive a whole one included, unless that bends it far back [rad or m]."""
        bends = self.movable & ~self.sideways & self.stated.isnan()
        if not bool(bends.any()) or not bool((whole := bends & self.motion.whole(bends)).any()):
            return self.straight
        found = self.motion.straight(self.straight, whole)
        return torch.where((found - self.straight).abs() < FAR_BACK, found, self.straight)

    @cached_property
    def sides(self) -> tuple[list[Curl], list[float]]:
        """How each finger curls, and where it closes: 1 to where it bends farther, -1 to the other side, 0 where nothing tells.

        Fingers that bend as far back as forth close to where fingertips meet.
        """
        straight, curls = self.straight, self.motion.curls(self.straight, self.movable & ~self.sideways)
        said = [float((curl.ways * self.stated_ways).sum()) for curl in curls]
        sides = [math.copysign(1.0, way) if way else float(curl.back < ONE_WAY) for way, curl in zip(said, curls, strict=True)]
        unsure = [i for i, curl in enumerate(curls) if not sides[i] and bool(curl.ways.any())]
        if not 0 < len(unsure) <= MOST_UNSURE:
            return curls, sides
        choices = torch.cartesian_prod(*[torch.tensor([1.0, -1.0])] * len(unsure)).reshape(-1, len(unsure))
        tried = torch.tensor(sides).repeat(len(choices), 1)
        tried[:, unsure] = choices
        # Fingers that one joint curls close together.
        each = torch.stack([curl.ways for curl in curls])
        shared = each @ each.T
        apart = (tried[:, :, None] * tried[:, None] * shared < 0).flatten(1).any(1)
        tried = tried[~apart] if bool((~apart).any()) else tried
        ways = tried @ each
        closed = torch.where(ways > 0, self.tree.upper, torch.where(ways < 0, self.tree.lower, straight))
        meeting = self.motion.meeting(straight, closed)
        best, most = tried[meeting.argmax()], meeting.max()
        # Without the best combinations in which a finger closes so, others bring fingertips less near to each other.
        lost = most - torch.where(tried == best, -torch.inf, meeting[:, None]).amax(0)
        decided = lost > torch.clamp(DECIDES * most / len(best), min=NEARER)
        return curls, torch.where(decided, best, 0.0).tolist()

    def folded(self, closing: Closing) -> Bool[Tensor, " n_tips"]:
        """Fingers that fold back before the joints are at their open ends."""
        shares = torch.linspace(1, 0, PATH).tolist()
        path = torch.stack([self.posture(closing.open_ends, closing.opening_signs, closing.abduction, s) for s in shares])
        axis = Line(_tensor(closing.palm.centre), _tensor(closing.palm.direction))
        both, bends = torch.tensor([curl.back >= BOTH_WAYS for curl in self.sides[0]]), self.movable & ~closing.abduction
        return self.motion.folded(path, bends, axis, both & ~self.of_one_joint(bends))

    def of_one_joint(self, bends: JointMask) -> Bool[Tensor, " n_tips"]:
        """Fingers that one joint bends, all of whose postures are as straight."""
        return (self.tree.moves[self.motion.links] & bends).sum(1) == 1

    @cached_property
    def motion(self) -> FingerMotion:
        """How the joints move the middles of the fingertips."""
        middles = torch.stack([self.coarse.middle(finger.tip) for finger in self.fingers])
        return FingerMotion(self.tree, self.fingers, middles)

    @cached_property
    def stand_in(self) -> tuple[Points, Points] | None:
        """Points [m] and normals in place of a palm without shape: between the knuckles, towards the tips; None of others.

        Where fingers begin to close alike, as those of flat hands, it faces where they close to.
        """
        if not self.on_palm.all():
            return None
        knuckles = self.motion.knuckles(self.start, self.movable).double().numpy()
        tips = self.motion.tips((self.tree.lower + self.tree.upper) / 2).double().numpy()
        faced = _unit(tips.mean(0) - knuckles.mean(0)) if self.sweep is None else self.sweep
        points = np.random.default_rng(0).dirichlet(np.ones(len(knuckles)), STAND_IN) @ knuckles
        return points, np.broadcast_to(faced, points.shape)

    @cached_property
    def palm_middle(self) -> Point:
        """Mean of the palm's samples [m]."""
        if self.stand_in is not None:
            return _tensor(self.stand_in[0].mean(0))
        return _tensor(self.coarse.posed(self.tree, self.rest)[0][self.on_palm].mean(0))

    def out_of_palm(self, opened: Joints, signs: Joints, palm: Palm) -> JointMask:
        """Joints that only spread fingers: their axes point out of the palm, at rest and with bent fingers alike."""
        bent = self.posture(opened, signs, torch.zeros_like(self.movable), 0.5)
        direction = _tensor(palm.direction)
        along = axes_along(self.tree, self.rest, direction) & axes_along(self.tree, bent, direction)
        spreading = self.motion.spreading(self.straight, self.sides[0], self.movable, direction, self.sweep)
        return along | self.sideways | spreading

    def examine(self, opened: Joints, signs: Joints, abduction: JointMask, faced: Place | None = None) -> Palm:
        """The palm at the closing where palm and fingers enclose a ball best; it faces a side if one is known or given."""
        jaw, on_palm, on_fingers = self.fixed_jaw(opened, signs, abduction), self.on_palm, self.on_fingers
        if jaw is not None:
            on_palm, on_fingers = on_palm & ~jaw.mask, [*on_fingers, jaw.mask]
        posed = [self.coarse.posed(self.tree, self.posture(opened, signs, abduction, share)) for share in self.closings]
        parts = [(*(self.stand_in or (points[on_palm], normals[on_palm])), [points[mask] for mask in on_fingers])
                 for points, normals in posed]
        best = max((find_palm(*part) for part in parts), key=lambda palm: palm.score)
        if jaw is not None:
            return dataclasses.replace(best, direction=jaw.direction)
        faced = self.sweep if faced is None else faced
        if faced is None or best.direction @ faced > FACING:
            return best
        with contextlib.suppress(HandError):
            best = max((find_palm(*part, faced) for part in parts), key=lambda palm: palm.score)
        return best if best.direction @ faced > FACING else dataclasses.replace(best, direction=faced)

    @cached_property
    def on_fingers(self) -> list[Bool[np.ndarray, " n"]]:
        """The samples on each finger."""
        return [np.isin(self.coarse.link.numpy(), finger.chain) for finger in self.fingers]

    def fixed_jaw(self, opened: Joints, signs: Joints, abduction: JointMask) -> FixedJaw | None:
        """The part of the palm that a single finger closes on; None for several fingers."""
        return None if len(self.fingers) != 1 else _single_jaw(
            self.fingers, lambda share: self.coarse.posed(self.tree, self.posture(opened, signs, abduction, share))[0],
            self.on_palm, self.on_fingers[0])

    def opened(self, signs: Joints) -> Joints:
        """The stated open posture; for other joints the limits towards which they open."""
        limits = torch.where(signs > 0, self.tree.upper, self.tree.lower)
        return torch.where(self.stated.isnan(), limits, self.stated)

    def away_from_limits(self, opened: Joints, signs: Float[Tensor, "*batch n_dof"]) -> Float[Tensor, "*batch n_dof"]:
        """The signs, but joints that are open at one of their limits close towards the other one."""
        room = AT_LIMIT * (self.tree.upper - self.tree.lower)
        at_lower, at_upper = opened - self.tree.lower < room, self.tree.upper - opened < room
        return torch.where(at_lower, -1.0, torch.where(at_upper, 1.0, signs))

    def posture(
        self, opened: Joints, signs: Float[Tensor, "*batch n_dof"], abduction: JointMask,
        share: float,
    ) -> Float[Tensor, "*batch n_dof"]:
        """Joints this share of the way from open to closed; those that are held or only spread fingers at rest."""
        closed = torch.where(signs > 0, self.tree.lower, self.tree.upper)
        return torch.where(self.movable & ~abduction, opened + share * (closed - opened), self.rest)


def _tensor(values: Float[np.ndarray, "3"]) -> Point:
    return torch.tensor(values, dtype=torch.float32)
