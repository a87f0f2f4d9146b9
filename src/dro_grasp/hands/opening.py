"""How far a hand opens: the widest posture of its fingers, and fingers that fold back behind the palm beyond it.

A joint's limits say how far it can move, not how far it is of use. A finger is open where it spans the most; one whose limits
let it fold back closes on nothing on the way from there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.geometry import se3
from dro_grasp.hands.anatomy import PARALLEL, Finger, JointMask, Joints, Point
from dro_grasp.hands.description.compiling import Note
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.kinematics.tree import REVOLUTE, KinematicTree

STEPS = 64  # Steps in which a joint's range, or the way from closed to open, is searched (ours)
SWEEPS = 24  # Most rounds of the search over all joints (ours); hands need 1 to 10
SAME_SPAN = 1e-4  # Spans that differ by less are the same [m] (ours)
EXACT = 1e-6  # Reaches that differ by less are the same, where a finger is to be straight whatever joints count from [m] (ours)
KNUCKLE = 0.5  # Range of a finger's knuckle, as a share of the widest range of its joints (ours); a metacarpal has less
BEHIND = 0.9
"""Angle by which an opened finger that folds back points behind the plane of its palm [rad] (ours). At the limits of their
ranges, 16 hands that open as they should have 0.82 at most, and most of them 0.3."""
TO_WRIST = 2.4
"""Angle between an open thumb and the other fingers from which on it points to the wrist [rad] (ours): 138 degrees. Of 31 hands
with a thumb, four have 142 to 160, all others 121 at most, but LEAP's, whose fingers do not lie side by side."""
LEAST_REACH = 0.35
"""Share of its widest reach below which a finger that opens farther folds back (ours). At the limits of their ranges, 16 hands
that open as they should keep 0.44 to 1; a finger that points straight back behind its knuckle keeps 0 or less."""
ALIKE = 0.9  # Cosine between the ways in which two joints move a fingertip from which on they bend the finger alike (ours)
ACROSS = 0.3  # Cosine up to which a joint moves a fingertip across such a way (ours)
ROLLING_UP = 8.0
"""Range of all joints of a finger together from which it may roll up [rad] (ours): 1.3 turns; Allegro's have 6.5. Limits that
say little are often half a turn for each joint."""
SPREADING = (1.0, 0.75)
"""Openness at which joints that move a finger sideways are looked for (ours): bent farther, they move it to the palm, too."""
FAR_BACK = 0.7  # Angle from which on a joint bends a finger far back [rad] (ours); fingers of hands bend back by 0.5 at most
BOTH_WAYS = 0.9
"""Least share of the way that a joint closes its finger by which it also bends it back, for that its limits are taken to say
nothing of how far it opens (ours). LEAP's thumb, which opens to its limits, has 0.71."""
ONE_WAY = 0.6
"""Share of how far it bends to one side, below which how far a finger bends to the other tells that it closes to the first
(ours). Of 16 hands, all fingers but LEAP's thumb (0.71), Shadow's (0.6) and D'Claw's have 0.4 at most."""
TO_PALM = 0.5  # Cosine up to which such a joint does not move it to the palm (ours)
WIDEST_SPREAD = 1.6  # Range below which a joint may spread a finger, where its axis is not along the palm's [rad] (ours)
LEVEL = 0.7  # Cosine from which on a fingertip moves along the line along which most of them move (ours)
IN_PLANE = 0.3  # Distance of a knuckle from the plane of the others that is none, as a share of its finger's reach (ours)
CURLED = 0.95  # Share of its longest reach below which a finger is not straight (ours)
LEAST_CURL = 0.3  # Angle below which limits do not tell to which side a finger curls [rad] (ours)
WAY = 25  # Postures on the way from straight to closed fingers at which fingertips are looked for near each other (ours)
STILL = 5e-3  # Slower fingertips do not move with a joint [m/rad or m/m] (ours)


@dataclass(frozen=True)
class Line:
    """A straight line: the palm's axis."""

    point: Point  # a point on it [m]
    direction: Point  # unit vector along it; zero for the point alone

    def span(self, tips: Float[Tensor, "*batch 3"], knuckles: Float[Tensor, "*batch 3"]) -> Float[Tensor, " *batch"]:
        """Distances of fingertips to the line [m]; negative for those on the other side of it than their knuckles."""
        tips, knuckles = self._across(tips), self._across(knuckles)
        return torch.where((tips * knuckles).sum(-1) >= 0, 1.0, -1.0) * tips.norm(dim=-1)

    def _across(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        offset = points - self.point
        return offset - (offset @ self.direction)[..., None] * self.direction


@dataclass(frozen=True)
class Curl:
    """How a finger curls: its hinges with parallel axes bend it the same way."""

    ways: Joints
    """+1 for joints that, increasing, curl it to the side to which it bends farther, -1 for those that straighten it so."""
    back: float
    """How far it bends to the other side, as a share of how far it bends to that one."""


@dataclass(frozen=True)
class FingerMotion:
    """Fingertips as functions of joints, in the root link's frame."""

    tree: KinematicTree
    fingers: tuple[Finger, ...]
    tip_points: Float[Tensor, "n_tips 3"]  # a point on each fingertip, in its link's frame [m]

    @staticmethod
    def of(hand: Hand) -> FingerMotion:
        """The motion of the middles of a hand's fingertips."""
        middles = torch.stack([hand.link_points[hand.link_index == tip].mean(0) for tip in hand.tips])
        return FingerMotion(hand.tree, hand.fingers, middles)

    @property
    def links(self) -> list[int]:
        """The fingertips' links."""
        return [finger.tip for finger in self.fingers]

    def tips(self, q: Float[Tensor, "*batch n_dof"]) -> Float[Tensor, "*batch n_tips 3"]:
        """Positions of the fingertips [m]."""
        return se3.apply(self.tree.forward(q)[..., self.links, :, :], self.tip_points)

    def velocities(self, q: Joints) -> Float[Tensor, "n_tips 3 n_dof"]:
        """Motion of each fingertip per motion of each joint [m/rad or m/m]."""
        poses = self.tree.forward(q)
        return self.tree.point_jacobian(poses, self.tips(q), torch.tensor(self.links))

    def way_of_bending(self, q: Joints) -> Point:
        """Unit vector along which most fingertips move when fingers bend, forth or back."""
        hinges = self.hinges(q)
        return main_axis((self.velocities(q)[..., hinges] if bool(hinges.any()) else self.velocities(q)).mT.reshape(-1, 3))

    def level(self, q: Joints) -> Bool[Tensor, " n_tips"]:
        """Fingers that bend towards one side of a plane in which their knuckles are, as those of a flat hand."""
        velocities, normal = self.velocities(q) * self.hinges(q), self.way_of_bending(q)
        everything = torch.ones(self.tree.n_dof, dtype=torch.bool)
        alike = (velocities * normal[:, None]).sum(1).abs().amax(-1) > LEVEL * velocities.norm(dim=1).amax(-1)
        height, reach = self.knuckles(q, everything) @ normal, self.reaches(q, everything).norm(dim=-1)
        return alike & ((height - height.median()).abs() < IN_PLANE * reach)

    def hinges(self, q: Joints) -> JointMask:
        """Joints that turn a finger about an axis parallel to that of another of its joints, or that are all it has."""
        axes, turns = self.tree.motion_axes(self.tree.forward(q))[1], torch.tensor(self.tree.kind) == REVOLUTE
        found = torch.zeros(self.tree.n_dof, dtype=torch.bool)
        for finger in self.fingers:
            links = torch.tensor([link for link in finger.chain if turns[link]], dtype=torch.long)
            alike = (axes[links] @ axes[links].T).abs() > PARALLEL
            hinges = links[(alike.sum(1) > 1) | (len(links) == 1)]
            found |= (self.tree.link_coupling[hinges] != 0).any(0)
        return found

    def curls(self, straight: Joints, moved: JointMask) -> list[Curl]:
        """The curl of each finger, by how far its hinges beyond the first bend it from where it is straight to either side."""
        angular = self.tree.motion_axes(self.tree.forward(straight))[1]
        up, down = self.tree.upper - straight, straight - self.tree.lower
        return [self._curl(finger, angular, moved, up, down) for finger in self.fingers]

    def _curl(self, finger: Finger, angular: Float[Tensor, "n_links 3"], moved: JointMask, up: Joints, down: Joints) -> Curl:
        turn = self.tree.link_coupling * moved
        links = [link for link in finger.chain if self.tree.kind[link] == REVOLUTE and bool(turn[link].any())]
        if not links:
            return Curl(torch.zeros_like(up), 1.0)
        alike = angular[links] @ angular[links].T
        far = turn[links].abs() @ (up + down)
        main = int(((alike.abs() > PARALLEL) * far).sum(1).argmax())
        hinges = [i for i in range(len(links)) if abs(float(alike[main, i])) > PARALLEL]
        turn = turn[[links[i] for i in hinges]] * alike[main, hinges].sign()[:, None]
        turn = turn * ((turn.amin(0) >= 0) | (turn.amax(0) <= 0))  # rods that keep a fingertip parallel curl nothing
        forth, back = (float((turn.relu() @ a + (-turn).relu() @ b)[1:].sum()) for a, b in ((up, down), (down, up)))
        ways = turn.sum(0).sign() * (1.0 if forth >= back else -1.0)
        return Curl(ways, min(forth, back) / max(forth, back, 1e-9) if max(forth, back) > LEAST_CURL else 1.0)

    def meeting(self, straight: Joints, closed: Float[Tensor, "*batch n_dof"]) -> Float[Tensor, " *batch"]:
        """By how much squared distances between fingertips shrink on the way from straight fingers to closed ones [m^2]."""
        shares = torch.linspace(0, 1, WAY).reshape(-1, *[1] * closed.dim())
        tips = self.tips(straight + shares * (closed - straight))
        apart = (tips[..., :, None, :] - tips[..., None, :, :]).square().sum(-1)
        return (apart[0] - apart.amin(0)).sum((-2, -1))

    def spreading(
        self, straight: Joints, curls: list[Curl], moved: JointMask, palm_direction: Point,
        sweep: Float[np.ndarray, "3"] | None,
    ) -> JointMask:
        """Joints that move a straight finger's tip a little across the way in which it curls, and not to the palm.

        Where fingers close alike along `sweep`, those of one that closes otherwise, a thumb, spread nothing.
        """
        velocity, found = self.velocities(straight), torch.zeros_like(moved)
        small = moved & (self.tree.joint_unit == 1) & (self.tree.upper - self.tree.lower < WIDEST_SPREAD)
        for row, (finger, curl) in enumerate(zip(self.fingers, curls, strict=True)):
            others = self.tree.moves[finger.tip] & (curl.ways == 0) & bool(curl.ways.any())
            ways = torch.nn.functional.normalize(velocity[row], dim=0)
            closing = torch.nn.functional.normalize(velocity[row] @ curl.ways, dim=0)
            if sweep is not None and abs(float(closing @ torch.from_numpy(sweep).float())) < LEVEL:
                continue
            across = ((closing @ ways).abs() < ACROSS) & ((palm_direction @ ways).abs() < TO_PALM)
            found |= small & others & across & (velocity[row].norm(dim=0) > STILL)
        return found

    def sideways(self, q: Joints, bends: JointMask, palm_direction: Point) -> JointMask:
        """Joints that move a fingertip across the way in which all other joints of its finger bend it, and not to the palm."""
        found, velocity = torch.zeros_like(bends), self.velocities(q)
        for row, finger in enumerate(self.fingers):
            joints = (self.tree.moves[finger.tip] & bends & (velocity[row].norm(dim=0) > STILL)).nonzero()[:, 0]
            ways = torch.nn.functional.normalize(velocity[row][:, joints], dim=0).T
            for i, joint in enumerate(joints.tolist()):
                others = ways[torch.arange(len(ways)) != i]
                if len(others) < 2:  # two at least must bend a finger alike
                    continue
                bending = main_axis(others)
                alike = bool((others @ bending).abs().min() > ALIKE)
                found[joint] |= alike and bool(torch.stack([bending, palm_direction]).mv(ways[i]).abs().max() < ACROSS)
        return found

    def bend(self, opened: Joints, closed: Joints) -> float:
        """Angle by which the joints of a finger turn in all from one posture to another, largest of all fingers [rad]."""
        turns = self.tree.link_coupling.abs() @ (closed - opened).abs() * (torch.tensor(self.tree.kind) == REVOLUTE)
        return max(float(turns[list(finger.chain)].sum()) for finger in self.fingers)

    def reaches(self, q: Float[Tensor, "*batch n_dof"], bends: JointMask) -> Float[Tensor, "*batch n_tips 3"]:
        """From the knuckle of each finger to its tip [m]."""
        return self.tips(q) - self.knuckles(q, bends)

    def knuckles(self, q: Float[Tensor, "*batch n_dof"], bends: JointMask) -> Float[Tensor, "*batch n_tips 3"]:
        """Positions of the knuckles [m]."""
        links = [self._knuckle(finger, bends) for finger in self.fingers]
        return se3.apply(self.tree.forward(q)[..., links, :, :], self.tree.anchor[links])

    def _knuckle(self, finger: Finger, bends: JointMask) -> int:
        """The first link that bends far; a metacarpal, which bends a little, is no knuckle."""
        chain = list(finger.chain)
        ranges = (self.tree.upper - self.tree.lower) / self.tree.joint_unit * bends
        far = ((self.tree.link_coupling[chain] != 0) * ranges).amax(-1)
        return chain[int((far >= KNUCKLE * far.max()).nonzero()[0, 0])]

    def widest(self, axis: Line, start: Joints, bends: JointMask) -> Joints:
        """The posture whose fingertips span the most, found joint by joint; of equal spans the one nearest to the start."""
        return self._best(lambda q: axis.span(self.tips(q), self.knuckles(q, bends)).sum(-1), start, bends)

    def straightest(self, start: Joints, bends: JointMask, same: float = SAME_SPAN) -> Joints:
        """The posture whose fingertips are farthest from their knuckles; of equal ones the one nearest to the start."""
        return self._best(lambda q: self.reaches(q, bends).norm(dim=-1).sum(-1), start, bends, same)

    def straight(self, start: Joints, bends: JointMask) -> Joints:
        """The posture whose fingertips are farthest from where their fingers begin to curl; of equal ones the nearest."""
        # A joint before that, as one that spreads the finger, makes it no straighter, wherever its axis is.
        hinged, firsts = self.hinges(start) & bends, []
        for finger in self.fingers:
            curling = [link for link in finger.chain if bool(hinged[self.tree.link_coupling[link] != 0].any())]
            free = bool(curling) and not bool(self._driving([finger], curling[:1]).any())
            firsts.append(curling[0] if free else self._knuckle(finger, bends))

        def reach(q: Float[Tensor, "m n_dof"]) -> Float[Tensor, " m"]:
            begin = se3.apply(self.tree.forward(q)[..., firsts, :, :], self.tree.anchor[firsts])
            return (self.tips(q) - begin).norm(dim=-1).sum(-1)

        return self._best(reach, start, bends, EXACT)

    def _best(
        self, measure: Callable[[Float[Tensor, "m n_dof"]], Float[Tensor, " m"]], start: Joints, moved: JointMask,
        same: float = SAME_SPAN,
    ) -> Joints:
        """The posture that measures most, found joint by joint."""
        q, tree = start, self.tree
        for _ in range(SWEEPS):
            before = q
            for joint in moved.nonzero()[:, 0].tolist():
                values = torch.linspace(float(tree.lower[joint]), float(tree.upper[joint]), STEPS + 1)
                values = torch.cat([start[joint, None], values])
                values = values[(values - start[joint]).abs().argsort(stable=True)]
                tried = q.repeat(len(values), 1)
                tried[:, joint] = values
                total = measure(tried)
                q = tried[int((total > total.max() - same).nonzero()[0, 0])]
            if torch.equal(q, before):
                break
        return q

    def knuckle_joints(self, bends: JointMask) -> JointMask:
        """The joints that move the knuckles' links, and none beyond them, where fingers are straight or bent."""
        return self.tree.moves[[self._knuckle(finger, bends) for finger in self.fingers]].any(0) & bends & ~self.whole(bends)

    def whole(self, bends: JointMask) -> JointMask:
        """Joints that bend a finger at its knuckle and, by couplings, beyond it: where it reaches farthest, it is not open."""
        return self._driving(self.fingers, [self._knuckle(finger, bends) for finger in self.fingers])

    def _driving(self, fingers: Sequence[Finger], firsts: list[int]) -> JointMask:
        """Joints that, by couplings, drive the given link of each finger and links beyond it."""
        beyond = [link for finger, first in zip(fingers, firsts, strict=True) for link in finger.chain if link > first]
        return (self.tree.link_coupling[firsts] != 0).any(0) & (self.tree.link_coupling[beyond] != 0).any(0)

    def folded(
        self, path: Float[Tensor, "steps n_dof"], bends: JointMask, axis: Line, both_ways: Bool[Tensor, " n_tips"]
    ) -> Bool[Tensor, " n_tips"]:
        """Fingers that, on a path to open, point behind the palm, or lose most of their reach if they bend both ways."""
        # They do so beyond their widest span, or beyond where they are straight.
        span, reach = axis.span(self.tips(path), self.knuckles(path, bends)), self.reaches(path, bends).norm(dim=-1)
        at = torch.where(reach.amin(0) < CURLED * reach.amax(0), reach.argmax(0), span.argmax(0))
        beyond = torch.arange(len(path))[:, None] >= at
        short = (self.kept(path, bends, at) < LEAST_REACH) & both_ways
        return (beyond & (short | (self.behind(path, bends, axis.direction) > BEHIND))).any(0)

    def behind(
        self, q: Float[Tensor, "*batch n_dof"], bends: JointMask, palm_direction: Point
    ) -> Float[Tensor, "*batch n_tips"]:
        """Angle by which each finger points behind the plane of the palm [rad]; negative in front of it."""
        reach = self.reaches(q, bends)
        return torch.asin((-(reach @ palm_direction) / reach.norm(dim=-1).clamp_min(1e-6)).clamp(-1, 1))

    def kept(
        self, path: Float[Tensor, "steps n_dof"], bends: JointMask, at: Int[Tensor, " n_tips"] | int = 0
    ) -> Float[Tensor, "steps n_tips"]:
        """Share of each finger's reach at one step of a path that it keeps at every step, measured along that reach."""
        reach = self.reaches(path, bends)
        then = reach[at, torch.arange(len(self.fingers))]
        return (reach * then).sum(-1) / then.square().sum(-1).clamp_min(1e-12)


def open_side_by_side(hand: Hand, openness: float) -> Joints:
    """`Hand.canonical_joints`, but all joints that move a finger sideways are neutral, so that no fingers cross [rad or m]."""
    # Joints that turn a finger about its length, or sit beyond its knuckle, count as bending: they spread it only where it
    # bends. At their open ends neighbours cross.
    q, motion, palm = hand.canonical_joints(openness), FingerMotion.of(hand), hand.palm_direction_wrist
    spreads = [motion.sideways(hand.canonical_joints(share), hand.movable, palm) for share in SPREADING]
    return torch.where(torch.stack(spreads).any(0) & hand.movable, hand.neutral, q)


def main_axis(vectors: Float[Tensor, "n 3"]) -> Point:
    """Unit vector along which most of the vectors lie, forth or back."""
    return torch.linalg.svd(vectors, full_matrices=False)[2][0]


def opening_notes(hand: Hand) -> list[Note]:
    """What the open posture leaves out, finger by finger, and the fingers that point behind the palm in it."""
    bends = hand.movable & ~hand.abduction
    behind = FingerMotion.of(hand).behind(hand.canonical_joints(1.0), bends, hand.palm_direction_wrist).tolist()
    notes = []
    for finger, angle in zip(hand.fingers, behind, strict=True):
        tip, left_out = hand.tree.link_names[finger.tip], _left_out(hand, finger)
        if left_out:
            notes.append(Note("info", tip, f"can open farther than the open posture, which leaves out {', '.join(left_out)}"))
        if angle > BEHIND:
            text = f"points {math.degrees(angle):.0f} degrees behind the palm in the open posture. Is the palm direction right?"
            notes.append(Note("warning", tip, text + " If so, state another open posture"))
    return notes + _thumb_to_wrist(hand)


def _thumb_to_wrist(hand: Hand) -> list[Note]:
    """A thumb that opens away from fingers that lie side by side, as those of a flat hand do."""
    if hand.thumb is None:
        return []
    reach = FingerMotion.of(hand).reaches(hand.canonical_joints(1.0), hand.movable & ~hand.abduction)
    along = torch.nn.functional.normalize(reach, dim=-1)
    others = along[torch.arange(len(along)) != hand.thumb].mean(0)
    angle = float(torch.acos(torch.nn.functional.cosine_similarity(along[hand.thumb], others, dim=0).clamp(-1, 1)))
    if angle < TO_WRIST or float(others.norm()) < ALIKE:
        return []
    text = (f"points {math.degrees(angle):.0f} degrees away from the other fingers in the open posture, towards the wrist. If "
            "it is of no use there, state another open posture")
    return [Note("warning", hand.tree.link_names[hand.tips[hand.thumb]], text)]


def guessed_side(hand: Hand) -> Note | None:
    """A flat hand whose limits do not tell its palm's side: its fingers, but for a thumb, bend as far back as forth."""
    stated = hand.tree if hand.description is None else hand.description.tree
    beyond = torch.where(hand.opening_signs > 0, stated.upper - hand.open_ends, hand.open_ends - stated.lower)
    both = (beyond >= BOTH_WAYS * (hand.closed_ends - hand.open_ends).abs()) & (beyond > FAR_BACK)
    lasts = [int(joints.nonzero()[-1, 0]) for tip in hand.tips if bool((joints := hand.tree.moves[tip] & hand.movable).any())]
    level = FingerMotion.of(hand).level((stated.lower + stated.upper) / 2)
    if min(int(both[lasts].sum()), int(level.sum())) < max(1, len(lasts) - (hand.thumb is not None)):
        return None
    return Note("warning", hand.tree.link_names[hand.palm], "has fingers that bend as far back as forth, so its inner side is "
                "a guess; look at the picture, and where the arrow is wrong, state limits that bend fingers to the other side, "
                "or a closed posture")


def _left_out(hand: Hand, finger: Finger) -> list[str]:
    """For each joint of a finger that can open farther than it does: how much of its range is not used."""
    tree, ends, limits = hand.tree, hand.open_ends.tolist(), hand.open_limits.tolist()
    shares = ((hand.open_limits.double() - hand.open_ends).abs() / (tree.upper.double() - tree.lower)).tolist()
    joints = (tree.moves[finger.tip] & hand.movable).nonzero()[:, 0].tolist()
    return [f"{shares[j]:.0%} of {tree.joint_names[j]} ({ends[j]:.2f} to {limits[j]:.2f})" for j in joints if shares[j] > 0]
