"""The stages of a lift, each timed within the limits and checked again as it is timed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from dro_grasp.planning.collisions import CollisionChecker
from dro_grasp.planning.motion import STAGES
from dro_grasp.planning.plan_config import PlanConfig
from dro_grasp.planning.reachability import Feasible, Postures, carried
from dro_grasp.planning.robot import Robot
from dro_grasp.planning.timing import STEP, Trajectory, cornered, joined, smooth, standing

TRAVEL_CLEARANCE = 0.001
"""Distance that the timed motion keeps while it travels, off the straight edges that were planned [m] (ours)."""


@dataclass(frozen=True)
class TimedStages:
    """A whole motion."""

    stage: Int[np.ndarray, " m"]
    """Index into STAGES of each sample."""
    arm: Trajectory
    hand: Trajectory


def timed_stages(
    robot: Robot, checker: CollisionChecker, waypoints: Float[np.ndarray, "k n_arm"], goal: Feasible, hand: Postures,
    config: PlanConfig,
) -> TimedStages | None:
    """From home along the waypoints to the standoff, to the grasp, and up; None if the timed motion touches something."""
    limits = robot.velocity, robot.acceleration
    n = len(hand.grasp)
    fingers = np.full(n, robot.hand_velocity), np.full(n, robot.hand_acceleration)
    reach = smooth(waypoints, *limits)
    if not _clear(checker, reach.position, hand.opened):
        reach = cornered(waypoints, *limits)
    standoff, grasp = goal.approach[0], goal.approach[-1]
    shape = smooth(np.stack([hand.opened, hand.pregrasp]), *fingers, STEP)  # each stage takes time, also if nothing moves
    # A spline through these would swing beyond them, and out of the joints' range.
    close = joined([cornered(closing(hand), *fingers, config.closing_seconds), standing(hand.squeeze, config.grip_seconds)])
    approach, lift = smooth(goal.approach, *limits, STEP), smooth(goal.lift, *limits, STEP)
    start = robot.T_world_wrist(grasp)
    free = _clear(checker, reach.position, hand.opened) and all(
        checker.free(standoff, posture, 0.0) for posture in shape.position) and all(
        checker.free(q, hand.pregrasp, 0.0, touch=True) for q in approach.position) and all(
        checker.free(grasp, posture, 0.0, touch=True) for posture in close.position) and all(
        checker.free(q, hand.squeeze, 0.0, carried(robot.T_world_wrist(q), start), touch=True) for q in lift.position)
    if not free:
        return None
    arms = [reach, _still(standoff, shape), approach, _still(grasp, close), lift]
    hands = [_still(hand.opened, reach), shape, _still(hand.pregrasp, approach), close, _still(hand.squeeze, lift)]
    lengths = [len(part.time) - (i > 0) for i, part in enumerate(arms)]
    return TimedStages(np.repeat(np.arange(len(STAGES)), lengths), joined(arms), joined(hands))


def closing(hand: Postures) -> Float[np.ndarray, "3 n_dof"]:
    """Postures while the hand closes: pregrasp, grasp, squeeze [rad or m]."""
    return np.stack([hand.pregrasp, hand.grasp, hand.squeeze])


def _clear(checker: CollisionChecker, positions: Float[np.ndarray, "k n_arm"], hand: Float[np.ndarray, " n_dof"]) -> bool:
    return all(checker.free(q, hand, TRAVEL_CLEARANCE) for q in positions)


def _still(q: Float[np.ndarray, " n"], other: Trajectory) -> Trajectory:
    """No motion at the times of another trajectory."""
    return replace(standing(q, 0.0), time=other.time, **{
        name: np.tile(row, (len(other.time), 1))
        for name, row in (("position", q), ("velocity", np.zeros_like(q)), ("acceleration", np.zeros_like(q)))})
