"""What plans are made of: inverse kinematics, paths round obstacles, and the time that a motion takes."""

from __future__ import annotations

import numpy as np
import pytest

import dro_grasp as dro
from dro_grasp.planning.inverse_kinematics import WristSolver
from dro_grasp.planning.paths import find_path
from dro_grasp.planning.reachability import Postures
from dro_grasp.planning.timed_stages import closing
from dro_grasp.planning.timing import USED, cornered, smooth


def test_inverse_kinematics_reaches_what_forward_kinematics_reached_and_nothing_beyond(robot: dro.Robot) -> None:
    solver, (lower, upper) = WristSolver(robot), robot.working_range
    generator = np.random.default_rng(3)
    seeds = [robot.home, *generator.uniform(lower, upper, (8, 7))]
    wanted = robot.T_world_wrist(generator.uniform(lower, upper, (10, 7)))
    found = [solver.solve(T, seeds) for T in wanted]
    assert sum(q is not None for q in found) >= 8
    for q, T in zip(found, wanted, strict=True):
        if q is not None:
            assert np.abs(robot.T_world_wrist(q) - T)[:3, 3].max() < 1e-3
            assert ((q >= lower) & (q <= upper)).all()
    far = np.eye(4)
    far[0, 3] = robot.longest_reach
    assert solver.solve(far, seeds[:2]) is None


def test_a_path_goes_round_a_wall_to_the_goal_that_can_be_reached() -> None:
    def free(q: np.ndarray) -> bool:
        return not (abs(q[0]) < 0.2 and q[1] < 0.6) and not (0.9 < np.abs(q - [0.7, -0.7]).max() * 5 < 1.1)

    low, high = np.array([-1.0, -1.0]), np.array([1.0, 1.0])
    start, goals = np.array([-0.8, -0.8]), np.array([[0.7, -0.7], [0.8, 0.2]])
    found = find_path(start, goals, free, low, high, 2.0, 0)
    assert found is not None
    assert found.goal == 1  # the other one is walled in
    assert np.allclose(found.waypoints[[0, -1]], [start, goals[1]])
    assert all(free(q) for q in found.waypoints)
    assert found.waypoints[:, 1].max() > 0.6
    again = find_path(start, goals, free, low, high, 2.0, 0)
    assert again is not None
    assert np.array_equal(again.waypoints, found.waypoints)
    assert find_path(start, goals[:1], free, low, high, 0.3, 0) is None


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


def test_a_closing_hand_stays_between_its_postures() -> None:
    """A spline through them overshoots: a finger that stops at the end of its range would leave it."""
    hand = Postures(np.zeros(2), np.array([0.2, 0.1]), np.array([1.0, 0.4]), np.array([1.0, 0.9]))
    limits = np.full(2, 2.0), np.full(2, 10.0)
    made, spline = cornered(closing(hand), *limits, 1.0), smooth(closing(hand), *limits, 1.0)
    assert made.position.max(0) == pytest.approx(hand.squeeze, abs=1e-9)
    assert spline.position[:, 0].max() > 1.001
