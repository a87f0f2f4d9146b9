"""From a grasp that can be reached to a timed motion: a path, then the stages of a lift, within limits and checked again.

Paths are of OMPL (RRT-Connect), and end at the first of several goals that can be reached; timing is of TOPP-RA.
"""

from __future__ import annotations

import logging
import time
import warnings
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from dro_grasp.arm.planning.motion import Trajectory
from dro_grasp.arm.planning.reachability import Feasible, Postures, Put, carried
from dro_grasp.arm.planning.workcell import CARRIED, CLEARANCE, Workcell
from dro_grasp.arm.robots.robot import Robot
from dro_grasp.extras import later

SPACING = 0.08  # Largest change of a joint between the waypoints of a path that is returned [rad or m] (ours)
STEP = 0.01  # Longest time between samples of a trajectory [s] (ours); each of its parts has samples at equal distances
USED = 0.95
"""Share of each limit that is used: they hold at points of a grid, and a motion that exceeds one between is slowed (ours)."""

NEARER = 0.004  # How much nearer than planned a timed motion may come to things [m] (ours): it is checked at more places
CARRY_SPEED = 0.5  # Share of the arm's velocities with which it carries an object [1] (ours): it is held by friction alone
CARRY_ACCELERATION = 0.25  # The same of its accelerations [1] (ours)
LOWER_SECONDS = 1.5  # Least time in which an object is lowered [s] (ours)
CLOSING_CHECKS = 9  # Postures between pregrasp and grasp in which the hand has to keep clear of the table (ours)
RELEASE_SECONDS = 1.5  # Least time in which the hand lets go [s] (ours)
RETREAT_SECONDS = 1.0  # Least time in which it leaves the object [s] (ours)
Pair = tuple[Trajectory, Trajectory]  # Of arm and hand, at the same times
Check = Callable[[Float[np.ndarray, " n"]], bool]  # Whether a configuration is free


def find_path(
    start: Float[np.ndarray, " n"], goals: Float[np.ndarray, "g n"], free: Check, lower: Float[np.ndarray, " n"],
    upper: Float[np.ndarray, " n"], seconds: float, seed: int,
) -> tuple[Float[np.ndarray, "k n"], int] | None:
    """Dense waypoints [rad or m] from the start to one of the goals, and its index; None if no path is found in `seconds`.

    Start and goals are free; the planner tries the goals in their order, and takes the one that it connects first. OMPL's
    generators, which the seed is of, are its own. The limit is of processor time, so that a busy machine finds the same path.
    """
    from ompl import base as ob, geometric as og, util as ou

    def state(q: Float[np.ndarray, " n"]) -> Any:
        made: Any = space.allocState()
        for i, value in enumerate(q.tolist()):
            made[i] = value
        return made

    def values(state: Any) -> Float[np.ndarray, " n"]:
        return np.array([state[i] for i in range(len(start))])

    def after(seconds: float) -> Any:
        end = time.thread_time() + seconds
        return ob.PlannerTerminationCondition(lambda: time.thread_time() > end)

    ou.setLogLevel(ou.LOG_NONE)
    ou.RNG.setSeed(seed + 1)  # OMPL takes zero for no seed
    space = ob.RealVectorStateSpace(len(start))
    bounds = ob.RealVectorBounds(len(start))
    for i in range(len(start)):
        bounds.setLow(i, float(lower[i]))
        bounds.setHigh(i, float(upper[i]))
    space.setBounds(bounds)
    setup = og.SimpleSetup(space)
    setup.setStateValidityChecker(lambda state: free(values(state)))
    information = setup.getSpaceInformation()
    # Configurations that are checked on an edge differ by at most 0.03 rad or m in all joints together (ours).
    information.setStateValidityCheckingResolution(0.03 / space.getMaximumExtent())
    setup.setStartState(state(start))
    goal_set = ob.GoalStates(information)
    for goal in goals:
        goal_set.addState(state(goal))
    setup.setGoal(goal_set)
    planner = og.RRTConnect(information)
    planner.setRange(0.6)  # longest edge of the trees [rad] (ours)
    setup.setPlanner(planner)
    setup.solve(after(seconds))
    if not setup.haveExactSolutionPath():  # `solve` is content with approximate paths
        return None
    setup.simplifySolution(after(3.0))  # seconds (ours): it ends by itself long before
    corners = np.array([values(s) for s in setup.getSolutionPath().getStates()])
    corners[0] = start
    return densified(corners, SPACING), int(np.linalg.norm(goals - corners[-1], axis=1).argmin())


def densified(corners: Float[np.ndarray, "k n"], spacing: float) -> Float[np.ndarray, "m n"]:
    """The same polyline with waypoints at most `spacing` apart, in the largest change of a joint."""
    pieces = []
    for a, b in pairwise(corners):
        count = max(1, int(np.ceil(np.abs(b - a).max() / spacing)))
        pieces.append(a + np.linspace(0, 1, count, endpoint=False)[:, None] * (b - a))
    return np.concatenate([*pieces, corners[-1:]])


def free_motion(
    robot: Robot, start: Float[np.ndarray, " n"], end: Float[np.ndarray, " n"],
    free: Callable[[Float[np.ndarray, " n"], float], bool], seconds: float, seed: int, clearance: float = CLEARANCE,
) -> Trajectory | None:
    """A timed motion of the arm between two free configurations; None if none is found.

    Args:
        robot: Its limits hold.
        start: Where it begins [rad or m].
        end: Where it ends.
        free: Whether a configuration keeps a distance [m] from things.
        seconds: See `find_path`.
        seed: Likewise.
        clearance: Distance that the path keeps [m].
    """
    found = find_path(start, end[None], lambda q: free(q, clearance), *robot.working_range, seconds, seed)
    if found is None:
        return None
    return timed_way(found[0], robot.velocity, robot.acceleration,
                     lambda way: all(free(q, clearance - NEARER) for q in way.position))


def timed_stages(
    cell: Workcell, waypoints: Float[np.ndarray, "k n_arm"], goal: Feasible, hand: Postures, closing_seconds: float,
    grip_seconds: float, carry: Float[np.ndarray, "j n_arm"] | None = None,
) -> tuple[Int[np.ndarray, " m"], Trajectory, Trajectory] | None:
    """From home along the waypoints to the standoff, to the grasp, and up; None if the timed motion touches something.

    The hand closes in `closing_seconds` at least, and then presses for `grip_seconds`. With waypoints `carry` from the end of
    the lift to above the goal's place, the object is put down there.

    Returns:
        Index into ALL_STAGES of each sample, the arm's motion and the hand's.
    """
    lifting = _lifting(cell, waypoints, goal, hand, closing_seconds, grip_seconds)
    if lifting is None:
        return None
    placing: list[Pair] | None = []
    if carry is not None and goal.put is not None:
        placing = _placing(cell, carry, goal.put, hand)
        if placing is None:
            return None
    arms, hands = zip(*lifting, *placing, strict=True)
    lengths = [len(part.time) - (i > 0) for i, part in enumerate(arms)]
    return np.repeat(np.arange(len(arms)), lengths), joined(list(arms)), joined(list(hands))


def _lifting(
    cell: Workcell, waypoints: Float[np.ndarray, "k n_arm"], goal: Feasible, hand: Postures, closing_seconds: float,
    grip_seconds: float,
) -> list[Pair] | None:
    """The STAGES; arguments as for `timed_stages`."""
    robot = cell.robot
    limits = robot.velocity, robot.acceleration
    fingers = robot.hand_velocity, robot.hand_acceleration

    def clear(reach: Trajectory) -> bool:
        return all(cell.free(q, hand.opened, CLEARANCE - NEARER) for q in reach.position)

    if (reach := timed_way(waypoints, *limits, clear)) is None:
        return None
    standoff, grasp = goal.approach[0], goal.approach[-1]
    shape = smooth(np.stack([hand.opened, hand.pregrasp]), *fingers, STEP)  # each stage takes time, also if nothing moves
    # A spline through these would swing beyond them, and out of the joints' range.
    close = joined([cornered(hand.closing, *fingers, closing_seconds), standing(hand.squeeze, grip_seconds)])
    approach, lift = smooth(goal.approach, *limits, STEP), smooth(goal.lift, *limits, STEP)
    start, to_grasp = robot.T_world_wrist(grasp), np.linspace(hand.pregrasp, hand.grasp, CLOSING_CHECKS)
    free = all(
        cell.free(standoff, posture, 0.0) for posture in shape.position) and all(
        cell.free(q, hand.pregrasp, 0.0, touch=True) for q in approach.position) and all(
        cell.free(grasp, posture, 0.0, touch=True) for posture in to_grasp) and all(
        cell.free(grasp, posture, 0.0, touch=True, aimed=True) for posture in close.position) and all(
        cell.free(q, hand.squeeze, 0.0, carried(robot.T_world_wrist(q), start), touch=True, aimed=True) for q in lift.position)
    if not free:
        return None
    return [(reach, still(hand.opened, reach)), (still(standoff, shape), shape), (approach, still(hand.pregrasp, approach)),
            (still(grasp, close), close), (lift, still(hand.squeeze, lift))]


def _placing(
    cell: Workcell, waypoints: Float[np.ndarray, "k n_arm"], put: Put, hand: Postures
) -> list[Pair] | None:
    """The stages PLACING, with the object in the hand; None if it hits something.

    The object is set down slowly, and the hand opens slowly: what is let go in a jerk tips over.
    """
    robot = cell.robot
    limits = robot.velocity, robot.acceleration
    gentle = CARRY_SPEED * robot.velocity, CARRY_ACCELERATION * robot.acceleration
    fingers = robot.hand_velocity, robot.hand_acceleration

    def clear(way: Trajectory, kept: float) -> bool:
        return all(
            cell.free(q, hand.squeeze, 0.0, carried(robot.T_world_wrist(q), put.T_grasp), touch=True, kept=kept, aimed=True)
            for q in way.position)

    if (carry := timed_way(waypoints, *gentle, lambda way: clear(way, CARRIED / 2), STEP)) is None:
        return None
    lower = smooth(put.lower, *gentle, LOWER_SECONDS)
    release = cornered(np.stack([hand.squeeze, hand.grasp, put.released]), *fingers, RELEASE_SECONDS)
    back = smooth(put.retreat, *limits, RETREAT_SECONDS)
    opening = smooth(np.stack([put.released, hand.opened]), *fingers, STEP)
    place, end = put.lower[-1], put.retreat[-1]
    opens = all(
        cell.free(place, posture, 0.0, put.moved, touch=True, kept=put.kept, aimed=True) for posture in release.position)
    free = clear(lower, put.kept) and opens and all(
        cell.free(q, put.released, 0.0, put.moved, touch=True, kept=put.kept) for q in back.position) and all(
        cell.free(end, posture, 0.0, put.moved, kept=put.kept) for posture in opening.position)
    if not free:
        return None
    retreat = joined([back, still(end, opening)]), joined([still(put.released, back), opening])
    return [(carry, still(hand.squeeze, carry)), (lower, still(hand.squeeze, lower)), (still(place, release), release),
            retreat]


def timed_way(
    waypoints: Float[np.ndarray, "k n"], velocity: Float[np.ndarray, " n"], acceleration: Float[np.ndarray, " n"],
    free: Callable[[Trajectory], bool], least_seconds: float = 0.0,
) -> Trajectory | None:
    """The quickest motion along planned waypoints that is free as it is timed; None if there is none.

    A smooth motion leaves the straight edges that were planned; where that takes it into something, the arm stops at their
    corners.
    """
    for timed in (smooth, cornered):
        if free(made := timed(waypoints, velocity, acceleration, least_seconds)):
            return made
    return None


def still(q: Float[np.ndarray, " n"], other: Trajectory) -> Trajectory:
    """No motion at the times of another trajectory."""
    rest = np.zeros((len(other.time), len(q)))
    return Trajectory(other.time, np.tile(q, (len(rest), 1)), rest, rest)


def smooth(
    waypoints: Float[np.ndarray, "k n"], velocity: Float[np.ndarray, " n"], acceleration: Float[np.ndarray, " n"],
    least_seconds: float = 0.0,
) -> Trajectory:
    """The quickest motion along a cubic spline through waypoints that are close together [rad or m], within limits.

    One that is quicker than `least_seconds` is slowed down.
    """
    # Waypoints nearer to each other are one.
    kept = [0, *(i for i in range(1, len(waypoints)) if np.abs(waypoints[i] - waypoints[i - 1]).max() > 1e-6)]
    points = waypoints[kept]
    if len(points) == 1:
        return standing(points[0], least_seconds)
    along = np.concatenate([[0.0], np.linalg.norm(np.diff(points, axis=0), axis=1).cumsum()])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with later("matplotlib", "pyplot"):  # with which it can draw
            import toppra
            from toppra import algorithm, constraint

        logging.getLogger("toppra").setLevel(logging.CRITICAL)
        limits = [constraint.JointVelocityConstraint(USED * np.stack([-velocity, velocity], 1)),
                  constraint.JointAccelerationConstraint(USED * np.stack([-acceleration, acceleration], 1))]
        path = toppra.SplineInterpolator(along, points, bc_type="natural")
        grid = np.linspace(0, along[-1], max(150, 3 * len(points)))  # where the limits hold (ours)
        timed = algorithm.TOPPRA(limits, path, gridpoints=grid, parametrizer="ParametrizeConstAccel").compute_trajectory(0, 0)
    if timed is None:
        raise RuntimeError("a path through its own waypoints has no timing within positive limits")
    fine = np.linspace(0, timed.duration, 600)
    excess = [1.0, least_seconds / timed.duration, float(np.abs(timed(fine, 1) / velocity).max()),
              float(np.abs(timed(fine, 2) / acceleration).max()) ** 0.5]
    slower = max(excess)
    duration = float(timed.duration) * slower
    time = np.linspace(0, duration, max(2, int(np.ceil(duration / STEP)) + 1))
    position, velocities, accelerations = (timed(time / slower, order) / slower**order for order in range(3))
    velocities[[0, -1]] = 0.0
    return Trajectory(time, position, velocities, accelerations)


def cornered(
    waypoints: Float[np.ndarray, "k n"], velocity: Float[np.ndarray, " n"], acceleration: Float[np.ndarray, " n"],
    least_seconds: float = 0.0,
) -> Trajectory:
    """The same along straight lines, with a stop at each corner: slow, and never off the path or beyond its ends.

    Waypoints are ends and corners, and any points between them; each line gets its share of `least_seconds` by length.
    """
    steps = np.diff(waypoints, axis=0)
    unit = steps / np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-12)
    turns = [i for i in range(1, len(steps)) if float(unit[i] @ unit[i - 1]) < 1 - 1e-9]
    corners = waypoints[[0, *turns, -1]]
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    share = (lengths + 1e-12) / (lengths + 1e-12).sum()  # without any way to go, the time passes all the same
    legs = zip(pairwise(corners), share, strict=True)
    return joined([smooth(np.stack(leg), velocity, acceleration, least_seconds * part) for leg, part in legs])


def standing(q: Float[np.ndarray, " n"], seconds: float) -> Trajectory:
    """No motion for a while."""
    time = np.linspace(0, seconds, max(2, int(np.ceil(seconds / STEP - 1e-9)) + 1)) if seconds > 0 else np.zeros(1)
    still = np.zeros((len(time), len(q)))
    return Trajectory(time, np.tile(q, (len(time), 1)), still, still)


def joined(parts: list[Trajectory]) -> Trajectory:
    """One trajectory after the other."""
    starts = np.concatenate([[0.0], np.cumsum([p.seconds for p in parts])])
    rows = [slice(None if i == 0 else 1, None) for i in range(len(parts))]  # each begins where the last one ended
    time = np.concatenate([p.time[r] + t for p, r, t in zip(parts, rows, starts[:-1], strict=True)])
    fields = [np.concatenate([getattr(p, name)[r] for p, r in zip(parts, rows, strict=True)])
              for name in ("position", "velocity", "acceleration")]
    return Trajectory(time, *fields)

