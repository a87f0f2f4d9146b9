"""Postures of a hand for work at a table: fingertips that point ahead to push, and a thumb and fingers around something flat.

Each finger is posed on its own by random search on its surface points, so that any hand with a thumb and two fingers serves.
Coordinates are those of the hand at work: ahead, along the palm direction; over, from the thumb towards the fingers; across.
Ours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.errors import OptionError
from dro_grasp.geometry.se3 import apply
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import Checked

AHEAD = 0  # Axis along the pointing fingers
OVER = 1  # Axis from the table up
ACROSS = 2  # Axis from finger to finger
LOWERED = (-0.01, 0.004, 0.015, 0.03)
"""How much lower than the pointing fingers the face is that they touch [m] (ours)."""
Cost = Callable[[Float[Tensor, "n k 3"], Bool[Tensor, " k"]], Float[Tensor, " n"]]
"""What speaks against n postures of a finger: of its k points, ahead, over and across [m], and which of them are of its tip."""


@dataclass(frozen=True)
class PostureConfig(Checked):
    """How postures are sought (ours)."""

    samples: int = 600
    """Random postures in each round, of which all but the first are around the best."""
    rounds: int = 7
    """Rounds; each halves the steps."""
    step: float = 0.15
    """Standard deviation of the first steps [share of a joint's range]."""
    misfit: float = 0.001
    """Depth in what is held, or distance from it, that costs 1 [m]."""
    apart: float = 0.004
    """Distance of the rest of a finger's tip from what is held that costs 1 [m]."""
    sideways: float = 0.01
    """Way to the side that costs 1 [m]."""
    short: float = 0.01
    """How much less far ahead a fingertip is that costs 1 [m]."""
    room: float = 0.015
    """Distance that what is held keeps from the palm [m]."""
    opening: float = 0.014
    """How far thumb and fingers move away from it in pregrasp [m]."""
    stiffness: float = 3.0
    """Stiffness of the servos [Nm/rad], as of `PinchConfig`."""


@dataclass(frozen=True, eq=False)
class WorkingHand:
    """A hand with the axes in which it works."""

    hand: Hand
    axes: Float[Tensor, "3 3"]
    """Ahead, over and across, as rows in the wrist frame."""
    pointing: Float[Tensor, " n_dof"]
    """Joints with the fingers pointing ahead as far as all of them do, and the thumb drawn back [rad or m]."""
    fingers: tuple[int, ...]
    """The fingers without the thumb."""
    config: PostureConfig = field(default_factory=PostureConfig)

    @staticmethod
    def of(hand: Hand, config: PostureConfig | None = None) -> WorkingHand:
        """Find them; they are kept with the hand.

        Raises:
            OptionError: The hand has no thumb, or less than two other fingers.
        """
        config = config or PostureConfig()
        return hand.kept(("working", config), lambda: _working(hand, config))

    def points(self, q: Float[Tensor, "*b n_dof"]) -> Float[Tensor, "*b k 3"]:
        """Surface points, ahead, over and across [m]."""
        return self.hand.points(q) @ self.axes.T

    def rows(self, finger: int) -> Int[Tensor, " k"]:
        """Which of them are of a finger."""
        return self.hand.finger_links[finger][self.hand.link_index].nonzero()[:, 0]

    def is_tip(self, finger: int) -> Bool[Tensor, " k"]:
        """Which points of a finger are of its tip."""
        return self.hand.link_index[self.rows(finger)] == self.hand.tips[finger]

    def tip(self, finger: int, q: Float[Tensor, " n_dof"]) -> Float[Tensor, "k 3"]:
        """Surface points of a fingertip, ahead, over and across [m]."""
        return self.points(q)[self.rows(finger)[self.is_tip(finger)]]

    def seek(
        self, finger: int, cost: Cost, start: Float[Tensor, " n_dof"], anywhere: bool = True
    ) -> tuple[Float[Tensor, " n_dof"], float]:
        """Joints with the posture of a finger that costs least, and that cost; others stay as at the start.

        The search begins anywhere, or around the start.
        """
        hand, generator, config = self.hand, torch.Generator().manual_seed(0), self.config
        rows, own, span = self.rows(finger), hand.finger_joints[finger] & hand.movable, hand.upper - hand.lower
        links, is_tip, best, least = hand.link_index[rows], self.is_tip(finger), start, float("inf")
        for number in range(config.rounds + 1):
            if number == 0 and anywhere:
                q = hand.random_joints(2 * config.samples, generator)
            else:
                noise = torch.randn(config.samples, len(span), generator=generator)
                q = (best + config.step / 2 ** max(0, number - 1) * span * noise).clamp(hand.lower, hand.upper)
                q[0] = best
            q = torch.where(own, q, best)
            found = cost(apply(hand.tree.forward(q)[:, links], hand.link_points[rows]) @ self.axes.T, is_tip)
            row = int(found.argmin())
            if float(found[row]) < least:
                best, least = q[row], float(found[row])
        return best, least


@dataclass(frozen=True, eq=False)
class FlatGrip:
    """Thumb and fingers on both sides of a slab, whose faces are level in the hand's coordinates."""

    pregrasp: Float[Tensor, " n_dof"]
    grasp: Float[Tensor, " n_dof"]
    face: float
    """How far over the face is that the fingers touch [m]; the thumb's is lower by the thickness."""
    cost: float
    """What speaks against it."""


def flat_grips(working: WorkingHand, thickness: float) -> list[FlatGrip]:
    """Grips of a slab of some thickness [m], the best first."""
    steps = round(thickness / 0.001)
    return working.hand.kept(("grips", working.config, steps), lambda: sorted(
        (_grip(working, 0.001 * steps, lower) for lower in LOWERED), key=lambda grip: grip.cost))


def _grip(working: WorkingHand, thickness: float, lower: float) -> FlatGrip:
    """The grip with the slab's face so much lower than the pointing fingers are [m]."""
    thumb, q = working.hand.thumb, working.pointing
    assert thumb is not None
    tips = [working.tip(finger, q) for finger in working.fingers]
    face = min(float(tip[:, OVER].min()) for tip in tips) - lower
    depth = min(float(tip[:, AHEAD].max()) for tip in tips)
    middle = {f: float(tip[:, ACROSS].mean()) for f, tip in zip(working.fingers, tips, strict=True)}
    middle[thumb] = sum(middle.values()) / len(middle)

    def posed(start: Float[Tensor, " n_dof"], gap: float, anywhere: bool) -> tuple[Float[Tensor, " n_dof"], float]:
        joints, total = start, 0.0
        for finger, side in (*((f, 1.0) for f in working.fingers), (thumb, -1.0)):
            at = face + gap if side > 0 else face - thickness - gap
            joints, cost = working.seek(finger, _beside(working, side, at, depth, middle[finger]), joints, anywhere)
            total += cost * (len(working.fingers) if side < 0 else 1)
        return joints, total

    grasp, cost = posed(q, 0.0, True)
    pregrasp, wide = posed(grasp, working.config.opening, False)
    return FlatGrip(pregrasp, grasp, face, cost + 0.5 * wide)


def pressing(
    working: WorkingHand, q: Float[Tensor, " n_dof"], fingers: Sequence[int], force: float
) -> Float[Tensor, " n_dof"]:
    """Joints at which fingers aim so that their tips together press towards those of the other side with a force [N]."""
    hand, step, aim = working.hand, 1e-3, q
    for finger in fingers:
        side = 1.0 if finger == hand.thumb else -1.0
        moved = q + step * torch.eye(len(q)) * hand.tree.joint_unit
        rows = working.rows(finger)[working.is_tip(finger)]
        over = working.points(torch.cat([q[None], moved]))[:, rows, OVER].mean(1)
        slope = (over[1:] - over[0]) / step * hand.movable  # lever of each joint [m]
        aim = aim + side * force / len(fingers) / working.config.stiffness * slope * hand.tree.joint_unit
    return aim.clamp(hand.tree.lower, hand.tree.upper)


def _beside(working: WorkingHand, side: float, at: float, depth: float, middle: float) -> Cost:
    """What speaks against a finger that lies on a face `at` [m] from one side, its tip in the middle and `depth` ahead."""
    config = working.config
    palm = float((working.hand.palm_centre_wrist @ working.axes.T)[AHEAD]) + config.room

    def cost(points: Float[Tensor, "n k 3"], is_tip: Bool[Tensor, " k"]) -> Float[Tensor, " n"]:
        above = side * (points[..., OVER] - at)
        inside = torch.where(points[..., AHEAD] > palm, above, 1.0)
        tip = above[:, is_tip]
        found = -inside.amin(1).clamp_max(0) / config.misfit + tip.amin(1).abs() / config.misfit
        found = found + (points[:, is_tip, ACROSS].mean(1) - middle).abs() / config.sideways
        ahead = points[..., AHEAD].amax(1)
        near = tip.topk(max(1, tip.shape[1] // 4), largest=False).values.mean(1)
        return found + near.abs() / config.apart + (depth - ahead).clamp_min(0) / config.short

    return cost


def _working(hand: Hand, config: PostureConfig) -> WorkingHand:
    fingers = tuple(i for i in range(len(hand.fingers)) if i != hand.thumb)
    if hand.thumb is None or len(fingers) < 2:
        raise OptionError(f"hand '{hand.name}' has no thumb and two fingers beside it, between which flat things fit; grasp "
                          "them as other things, by dro_grasp.plan")

    def ahead_of(points: Float[Tensor, "n k 3"], is_tip: Bool[Tensor, " k"]) -> Float[Tensor, " n"]:
        return points[..., AHEAD].amax(1)

    def behind(points: Float[Tensor, "n k 3"], is_tip: Bool[Tensor, " k"]) -> Float[Tensor, " n"]:
        return -ahead_of(points, is_tip)

    ahead = torch.nn.functional.normalize(hand.palm_direction_wrist, dim=0)
    made = WorkingHand(hand, ahead.expand(3, 3), hand.canonical_joints(1.0), fingers, config)  # other axes do not matter yet
    joints, depths = made.pointing, []
    for finger in fingers:
        joints, cost = made.seek(finger, behind, joints)
        depths.append(-cost)
    places = {f: hand.points(joints)[made.rows(f)[made.is_tip(f)]].mean(0) for f in fingers}
    folded = made.seek(hand.thumb, behind, joints)[0]
    thumb = hand.points(folded)[made.rows(hand.thumb)[made.is_tip(hand.thumb)]].mean(0)
    tips = torch.stack(list(places.values()))
    apart = (tips[:, None] - tips).norm(dim=-1)
    across = tips[int(apart.argmax()) % len(tips)] - tips[int(apart.argmax()) // len(tips)]
    across = torch.nn.functional.normalize(across - (across @ ahead) * ahead, dim=0)
    over = torch.linalg.cross(across, ahead)
    over, across = (over, across) if float((tips.mean(0) - thumb) @ over) > 0 else (-over, -across)
    made = replace(made, axes=torch.stack([ahead, over, across]))
    depth = min(depths) - 0.0005  # which all of them reach [m]
    in_line = float(sum(place @ over for place in places.values()) / len(places))
    for finger in fingers:
        middle = float(places[finger] @ across)

        def uneven(points: Float[Tensor, "n k 3"], is_tip: Bool[Tensor, " k"], middle: float = middle) -> Float[Tensor, " n"]:
            tip = points[:, is_tip].mean(1)
            aside = (tip[:, ACROSS] - middle).abs() + (tip[:, OVER] - in_line).abs()
            return (ahead_of(points, is_tip) - depth).abs() + 0.2 * aside

        joints = made.seek(finger, uneven, joints, anywhere=False)[0]
    return replace(made, pointing=made.seek(hand.thumb, ahead_of, joints)[0])
