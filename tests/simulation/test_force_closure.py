from __future__ import annotations

import cvxpy as cp
import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from dro_grasp.simulation.contacts import q1, wrench_error


def contacts(n, seed):
    """Contacts on an ellipsoid, with its inward normals."""
    unit = np.random.default_rng(seed).normal(size=(n, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    radii = np.array([0.02, 0.03, 0.05])
    normals = -unit / radii
    return unit * radii, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def axes(normal):
    """Two tangents, as DexGraspBench chooses them."""
    base = np.array([0, 0, 1.0]) if abs(normal[1]) > 0.99 else np.array([0, 1.0, 0])
    first = base - base @ normal * normal
    first /= np.linalg.norm(first)
    return first, np.cross(normal, first)


def least_support(points):
    """The least distance of a supporting plane of the points to the origin, by linear programmes from many directions.

    Among vectors with the component 1 along a direction, the one of least support is no shorter than the direction, so its own
    direction has no larger support.
    """
    least, rows = np.inf, np.column_stack([points, -np.ones(len(points))])
    for direction in np.random.default_rng(0).normal(size=(40, points.shape[1])):
        value, direction = np.inf, direction / np.linalg.norm(direction)
        while (now := (points @ direction).max()) < value - 1e-9:
            value = now
            best = linprog([0.0] * len(direction) + [1.0], rows, np.zeros(len(rows)), [[*direction, 0.0]], [1.0],
                           bounds=(None, None)).x[:-1]
            direction = best / np.linalg.norm(best)
        least = min(least, value)
    return least


@pytest.mark.parametrize(("n", "seed"), [(3, 25), (4, 12), (5, 7)])
def test_q1_is_the_smallest_support_of_the_wrench_space(n, seed):
    points, normals = contacts(n, seed)
    friction, levers = 0.5, points - points.mean(0)
    levers = levers / np.linalg.norm(levers, axis=1).mean()
    wrenches = [np.zeros(6)]
    for lever, normal in zip(levers, normals, strict=True):
        t, s = axes(normal)
        for angle in np.arange(8) * np.pi / 4:
            force = normal + friction * (np.sin(angle) * t + np.cos(angle) * s)
            wrenches.append(np.concatenate([force, np.cross(lever, force)]))
    wrenches = np.array(wrenches)
    assert q1(points, normals, friction) == pytest.approx(least_support(wrenches), abs=1e-5)


def test_q1_is_the_same_in_another_frame_and_at_another_size():
    points, normals = contacts(5, 7)
    round_cone = q1(points, normals, 0.5)
    assert round_cone > 0.01
    assert q1(3 * points + 1.0, normals, 0.5) == pytest.approx(round_cone, rel=1e-3)
    turn = Rotation.from_rotvec([0, 0.4, 0]).as_matrix()  # about y, along which tangents are taken
    assert q1(points @ turn.T, normals @ turn.T, 0.5) == pytest.approx(round_cone, rel=1e-3)


@pytest.mark.parametrize("n", [1, 2])
def test_few_contacts_have_no_force_closure_by_q1(n):
    points = np.array([[0.02, 0, 0], [-0.02, 0, 0]])[:n]
    assert q1(points, -points / 0.02, 0.5) < 1e-9


@pytest.mark.parametrize(("n", "seed"), [(1, 0), (2, 1), (3, 2), (4, 3), (5, 4)])
def test_the_wrench_error_is_the_solution_of_its_quadratic_programme(n, seed):
    points, normals = contacts(n, seed)
    friction, torsional = 0.3, 0.01
    columns = []
    for lever, normal in zip(points - points.mean(0), normals, strict=True):
        t, s = axes(normal)
        for side in (friction * t, -friction * t, friction * s, -friction * s):
            columns.append(np.concatenate([normal + side, np.cross(lever, normal + side)]))
        for twist in (torsional, -torsional):
            columns.append(np.concatenate([normal, np.cross(lever, normal) + twist * normal]))
    grasp, errors = np.array(columns).T, []
    for force in np.concatenate([np.eye(3), -np.eye(3)]):
        x = cp.Variable((n, 6), nonneg=True)
        rest = grasp @ cp.vec(x, order="C") + np.concatenate([0.1 * force, np.zeros(3)])
        problem = cp.Problem(cp.Minimize(cp.sum_squares(rest)), [cp.sum(x, axis=1) <= 1, cp.sum(x) >= 1])
        errors.append(np.sqrt(max(0.0, problem.solve(solver=cp.CLARABEL))))
    assert wrench_error(points, normals, friction, torsional) == pytest.approx(np.mean(errors), abs=1e-5)


def test_two_opposing_contacts_resist_what_their_friction_resists():
    points = np.array([[0, 0.02, 0], [0, -0.02, 0]])
    assert wrench_error(points, -points / 0.02, 0.5, 0.01) < 1e-5
    # Side by side they can only push: against the push nothing is left, along it their whole least push and the force.
    pushing = wrench_error(np.array([[0.01, 0, 0], [-0.01, 0, 0]]), np.array([[0, 1.0, 0], [0, 1.0, 0]]), 0.0, 0.0)
    assert pushing == pytest.approx((1.1 + 0.9 + 4 * np.hypot(1.0, 0.1)) / 6, abs=1e-4)
