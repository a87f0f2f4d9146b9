"""Paths round obstacles, the time that a motion takes, and its stages."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

import dro_grasp as dro
from dro_grasp.arm.planning.motion import STAGES, MotionPlan, Trajectory
from dro_grasp.arm.planning.reachability import Feasible, Postures
from dro_grasp.arm.planning.trajectory import (
    NEARER,
    STEP,
    USED,
    cornered,
    densified,
    find_path,
    free_motion,
    smooth,
    standing as standing_still,
    timed_stages,
    timed_way,
)
from dro_grasp.arm.planning.workcell import Workcell


def test_a_path_goes_round_a_wall_to_the_goal_that_can_be_reached() -> None:
    def free(q: np.ndarray) -> bool:
        return not (abs(q[0]) < 0.2 and q[1] < 0.6) and not (0.9 < np.abs(q - [0.7, -0.7]).max() * 5 < 1.1)

    low, high = np.array([-1.0, -1.0]), np.array([1.0, 1.0])
    start, goals = np.array([-0.8, -0.8]), np.array([[0.7, -0.7], [0.8, 0.2]])
    found = find_path(start, goals, free, low, high, 2.0, 0)
    assert found is not None
    waypoints, goal = found
    assert goal == 1  # the other one is walled in
    assert np.allclose(waypoints[[0, -1]], [start, goals[1]])
    assert all(free(q) for q in waypoints)
    assert waypoints[:, 1].max() > 0.6
    again = find_path(start, goals, free, low, high, 2.0, 0)
    assert again is not None
    assert np.array_equal(again[0], waypoints)
    assert find_path(start, goals[:1], free, low, high, 0.3, 0) is None


def test_a_machine_that_is_busy_finds_the_same_path() -> None:
    low, high = np.array([-1.0, -1.0]), np.array([1.0, 1.0])
    start, goal = np.array([-0.8, 0.0]), np.array([[0.8, 0.0]])

    def found(pause: float) -> np.ndarray | None:
        checks = 0

        def free(q: np.ndarray) -> bool:
            nonlocal checks
            checks += 1
            if checks in (10, 20, 30):
                time.sleep(pause)  # others have the processor
            return not (abs(q[0]) < 0.2 and q[1] < 0.6)

        path = find_path(start, goal, free, low, high, 0.5, 0)
        assert checks > 30
        return None if path is None else path[0]

    quiet, busy = found(0.0), found(0.3)
    assert quiet is not None
    assert busy is not None
    assert np.array_equal(quiet, busy)


def test_one_joint_takes_the_time_that_a_trapezoid_takes() -> None:
    velocity, acceleration, way = 1.5, 4.0, 2.0
    v, a = USED * velocity, USED * acceleration
    for timed in (smooth, cornered):
        made = timed(np.linspace(0, way, 9)[:, None], np.array([velocity]), np.array([acceleration]))
        assert made.seconds == pytest.approx(way / v + v / a, rel=0.02)
        assert np.allclose(made.velocity[[0, -1]], 0, atol=1e-6)


def test_corners_are_stops_and_nothing_leaves_the_lines() -> None:
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    made = cornered(corners, np.ones(2), np.ones(2))
    assert np.abs(made.position - made.position.clip(0, 1)).max() < 1e-9
    assert np.minimum(np.abs(made.position[:, 1]), np.abs(made.position[:, 0] - 1)).max() < 1e-9
    slow = cornered(corners, np.ones(2), np.ones(2), 20.0)
    assert slow.seconds == pytest.approx(20.0, abs=0.05)
    assert np.abs(slow.position[np.abs(slow.time - 10.0).argmin()] - corners[1]).max() < 1e-3
    assert cornered(corners[[0, 0]], np.ones(2), np.ones(2), 0.5).seconds == pytest.approx(0.5)


def test_an_arm_stops_at_corners_only_where_a_smooth_way_is_not_free() -> None:
    corners = densified(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]), 0.2)

    def on_lines(way: Trajectory) -> bool:
        return np.minimum(np.abs(way.position[:, 1]), np.abs(way.position[:, 0] - 1)).max() < 1e-6

    smooth_way = timed_way(corners, np.ones(2), np.ones(2), lambda way: True)
    stopping = timed_way(corners, np.ones(2), np.ones(2), on_lines, 9.0)
    assert smooth_way is not None
    assert stopping is not None
    assert not on_lines(smooth_way)
    assert on_lines(stopping)
    assert smooth_way.seconds < cornered(corners, np.ones(2), np.ones(2)).seconds
    assert stopping.seconds == pytest.approx(9.0, abs=0.05)
    assert timed_way(corners, np.ones(2), np.ones(2), lambda way: False) is None


def test_a_free_motion_keeps_its_distance_as_planned_and_nearly_as_timed(robot: dro.Robot) -> None:
    end, asked = robot.home + 0.2, list[tuple[float, float]]()

    def free(q: np.ndarray, kept: float) -> bool:
        asked.append((float(q[0]), kept))
        return kept > 0.003 or timed_is_free

    timed_is_free = True
    made = free_motion(robot, robot.home, end, free, 2.0, 0, 0.006)
    assert made is not None
    np.testing.assert_allclose(made.position[[0, -1]], [robot.home, end], atol=1e-9)
    assert {kept for _, kept in asked} == {0.006, 0.006 - NEARER}
    assert {q for q, kept in asked if kept < 0.006} == set(made.position[:, 0].tolist())
    timed_is_free = False
    assert free_motion(robot, robot.home, end, free, 2.0, 0, 0.006) is None


def test_a_closing_hand_stays_between_its_postures() -> None:
    """A spline through them overshoots: a finger that stops at the end of its range would leave it."""
    hand = Postures(np.zeros(2), np.array([0.2, 0.1]), np.array([1.0, 0.4]), np.array([1.0, 0.9]))
    limits = np.full(2, 2.0), np.full(2, 10.0)
    made, spline = cornered(hand.closing, *limits, 1.0), smooth(hand.closing, *limits, 1.0)
    assert made.position.max(0) == pytest.approx(hand.squeeze, abs=1e-9)
    assert spline.position[:, 0].max() > 1.001


def test_samples_are_at_most_a_step_apart(planned: MotionPlan) -> None:
    assert np.diff(planned.arm.time).max() < STEP + 1e-9
    for seconds, count in ((0.0149, 3), (0.5, 51), (0.0, 1)):
        assert len(standing_still(np.zeros(2), seconds).time) == count


@pytest.mark.parametrize("still", ["shape", "approach", "lift"])
def test_a_stage_in_which_nothing_moves_is_a_stage(robot: dro.Robot, planned: MotionPlan, still: str) -> None:
    """As when the pregrasp is the posture in which the hand travels."""
    opened = robot.hand.canonical_joints().double().numpy()
    bent, turned = opened + (still != "shape") * 0.05 * robot.hand.opening_signs.double().numpy(), np.eye(7)[0]
    approach, lift = (np.linspace(robot.home + a * turned, robot.home + b * turned, 5) for a, b in (
        (0.1, 0.1 if still == "approach" else 0.15), (0.15, 0.15 if still == "lift" else 0.2)))
    cell, hand = Workcell(replace(robot, table=None)), Postures(opened, bent, opened, opened)
    made = timed_stages(cell, np.stack([robot.home, approach[0]]), Feasible(0, approach, lift), hand, 1.0, 0.5)
    assert made is not None
    stages, arm, fingers = made
    whole = replace(planned, stage=stages, arm=arm, hand=fingers)
    assert f"{still} 0.0 s" in whole.lines()[2]
    assert (np.diff(whole.arm.time) > 0).all()
    assert sorted(set(stages.tolist())) == list(range(len(STAGES)))
    assert all(np.ptp(whole.arm.position[whole.part(s)], axis=0).max() > 0 for s in ("reach", "approach", "lift") if s != still)
