"""Motions of an arm, picture by picture, with words for each: what is done, and whether the hand holds something."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from dro_grasp.arm.planning.motion import ALL_STAGES, SLIDING, MotionPlan
from dro_grasp.arm.planning.reachability import carried
from dro_grasp.arm.robots.robot import Robot
from dro_grasp.arm.tabletop.animation import Recorder
from dro_grasp.errors import OptionError
from dro_grasp.grasps.hold import HoldState
from dro_grasp.objects.shape import ObjectModel

RATE = 25.0  # Pictures a second (ours)
WORDS = {
    "reach": "the arm travels to the thing, the hand open",
    "shape": "the hand takes the shape from which it closes",
    "approach": "straight to the grasp",
    "press": "fingertips press the thing onto the table",
    "slide": "they push it towards an edge of the table",
    "look again": "the arm goes home, and the camera looks again",
    "close": "the hand closes and presses",
    "lift": "straight up",
    "carry": "the arm carries the thing to its place",
    "lower": "straight down to the place",
    "release": "the hand opens and lets go",
    "retreat": "straight back from the thing",
}
"""What happens in each stage."""
AFTER = "the arm holds the thing, and shakes it"  # What happens where an attempt goes on after the lift
MEASURED = ("lift", "carry", "lower")  # Stages in which the hand should hold something


@dataclass(frozen=True, eq=False)
class Film:
    """A motion, picture by picture."""

    arm: Float[np.ndarray, "k n_arm"]  # [rad or m]
    hand: Float[np.ndarray, "k n_dof"]  # [rad or m]
    poses: Float[np.ndarray, "k o 4 4"]  # Of the objects in the world [m]; of a plan, those of the cloud that it was made for
    plan: MotionPlan | None
    objects: tuple[ObjectModel, ...] = ()  # As simulated; none in a plan
    words: tuple[str, ...] = ()  # Of each picture, in Markdown
    held: tuple[tuple[HoldState, float] | None, ...] = ()  # What the joints say in each, and how surely; None for nothing

    @staticmethod
    def of_plan(robot: Robot, plan: MotionPlan) -> Film:
        """A plan as it is meant: the hand carries the object from the lift on, until it puts it down, or has pushed it."""
        points = list(plan.points(RATE))
        of_arm, of_hand = plan.drivers
        arm, hand = of_arm.joints(np.stack([p.arm for p in points])), of_hand.joints(np.stack([p.hand for p in points]))
        words = tuple(_staged(p.stage) for p in points)
        if plan.notes.slide is not None:
            ended = np.array([SLIDING.index(p.stage) > SLIDING.index("slide") for p in points])
            pushed = np.where(ended[:, None, None, None], np.array(plan.notes.slide), np.eye(4))
            return Film(arm, hand, pushed, plan, words=words)
        wrist = robot.T_world_wrist(arm)
        stage = np.array([ALL_STAGES.index(p.stage) for p in points])
        lifts, releases = ALL_STAGES.index("lift"), ALL_STAGES.index("release")
        start, held = plan.held_from(robot), (stage >= lifts) & (stage < releases)
        poses = np.tile(np.eye(4), (len(points), 1, 1, 1))
        poses[held, 0] = np.stack([carried(T, start) for T in wrist[held]])
        if (stage >= releases).any():
            end = robot.T_world_wrist(plan.arm.position[plan.part("lower")][-1])
            poses[stage >= releases, 0] = carried(end, start)
        return Film(arm, hand, poses, plan, words=words)

    @staticmethod
    def of_attempt(recorder: Recorder) -> Film:
        """What was simulated, with what the joints say of the hand once it should hold something."""
        if not recorder.frames:
            raise OptionError("the attempt ended before the robot moved; there is nothing to play")
        arm, hand, poses = (np.stack(part) for part in zip(*recorder.frames, strict=True))
        plans, told = recorder.plans, []
        for begin, end in pairwise([*(begin for begin, _ in plans), len(hand)]):
            plan = dict(plans)[begin]
            told += [moment_of(plan, (i - begin) / recorder.rate, hand[i]) for i in range(begin, end)]
        words, held = tuple(words for words, _ in told), tuple(held for _, held in told)
        return Film(arm, hand, poses, plans[-1][1] if plans else None, recorder.objects, words, held)


def moment_of(
    plan: MotionPlan, time: float, joints: Float[np.ndarray, " n_dof"]
) -> tuple[str, tuple[HoldState, float] | None]:
    """What happens at a time [s] of a motion that follows a plan, and what the joints of the hand say then [rad or m]."""
    row = int(np.searchsorted(plan.arm.time, time, side="left"))
    over = row >= len(plan.stage)
    names = ALL_STAGES if plan.notes.slide is None else SLIDING
    stage = names[int(plan.stage[min(row, len(plan.stage) - 1)])]
    words = f"**after the lift**: {AFTER}" if over and plan.notes.place is None and names is ALL_STAGES else _staged(stage)
    if plan.hold is None or stage not in MEASURED:
        return words, None
    check = plan.check_hold(joints)
    said = f"by its joints, the hand is **{check.state}** ({check.confidence:.0%} sure)"
    return f"{words}  \n{said}", (check.state, check.confidence)


def _staged(stage: str) -> str:
    return f"**{stage}**: {WORDS[stage]}"
