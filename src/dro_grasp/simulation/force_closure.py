"""Analytic measures of force closure, from contact points and normals alone.

Source: the evaluation of DexGraspBench, whose definitions, scales and tangents these follow, so that values compare. Q1 is
Ferrari and Canny's, the least wrench that breaks the grasp.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls
from scipy.spatial import ConvexHull, QhullError

EDGES = 8
"""Edges of the pyramid that stands for a friction cone in Q1. Source: DexGraspBench."""
DISTURBANCE = 0.1
"""Force to be resisted, of the largest normal force of a contact [1]. Source: DexGraspBench."""
ALONG_Y = 0.99
"""Cosine to the y axis from which tangents are taken from the z axis instead [1]. Source: DexGraspBench."""
HARD = 1e4
"""Weight of an equation that must hold, beside one of weight 1 (ours): it is off by about its inverse square."""


def q1(points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], friction: float) -> float:
    """Radius of the largest ball about the origin within the wrenches of contacts whose normal forces are at most 1 each.

    The wrench space is the convex hull of the contacts' wrenches and of none. Torques are about the mean of the points, with
    their mean distance to it as the unit of length. Zero: some wrench cannot be resisted at all.

    Args:
        points: Contact points [m].
        normals: Unit normals, from hand to object.
        friction: Coefficient of friction.
    """
    offset = points - points.mean(0)
    grasp = _grasp_maps(offset / (np.linalg.norm(offset, axis=1).mean() + 1e-6), normals)
    angles = 2 * np.pi * np.arange(EDGES) / EDGES
    cone = np.stack([np.ones(EDGES), friction * np.sin(angles), friction * np.cos(angles)])
    wrenches = (grasp[:, :, :3] @ cone).transpose(0, 2, 1).reshape(-1, 6)
    try:
        hull = ConvexHull(np.concatenate([wrenches, np.zeros((1, 6))]))
    except QhullError:
        # Flat: there are wrenches that no force resists.
        return 0.0
    return float(np.abs(hull.equations[:, 6]).min())


def wrench_error(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], friction: float, torsional: float
) -> float:
    """What the best contact forces leave of a force along each half-axis, averaged: the QP form of force closure.

    Forces obey friction; no contact presses with more than 1, all together press with at least 1. The error is the length of
    the remaining wrench, its torque about the mean of the points in metres of lever arm.

    Args:
        points: Contact points [m].
        normals: Unit normals, from hand to object.
        friction: Coefficient of friction.
        torsional: Coefficient of torsional friction [m].
    """
    n = len(points)
    edges = np.zeros((6, 6))
    edges[0] = 1.0
    edges[1, :2] = edges[2, 2:4] = friction, -friction
    edges[3, 4:] = torsional, -torsional
    columns = (_grasp_maps(points - points.mean(0), normals) @ edges).transpose(1, 0, 2).reshape(6, 6 * n)
    # Inequalities become equations with slacks; all unknowns are then non-negative.
    system = np.zeros((6 + n + 1, 6 * n + n + 1))
    system[:6, : 6 * n] = columns
    system[6:-1, : 6 * n] = HARD * np.kron(np.eye(n), np.ones(6))
    system[6:-1, 6 * n : -1] = HARD * np.eye(n)
    system[-1, : 6 * n] = HARD
    system[-1, -1] = -HARD
    target, errors = np.zeros(len(system)), []
    target[6:] = HARD
    for force in DISTURBANCE * np.concatenate([np.eye(3), -np.eye(3)]):
        target[:3] = force
        errors.append(np.linalg.norm(columns @ nnls(system, target)[0][: 6 * n] - target[:6]))
    return float(np.mean(errors))


def _grasp_maps(levers: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 6 6"]:
    """Force and torque along normal and tangents of each contact, to force and torque at the origin."""
    along_y = np.abs(normals[:, 1:2]) > ALONG_Y
    tangent = np.where(along_y, [0.0, 0.0, 1.0], [0.0, 1.0, 0.0])
    tangent = tangent - (tangent * normals).sum(1, keepdims=True) * normals
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    axes = np.stack([normals, tangent, np.cross(normals, tangent)], -1)
    maps = np.zeros((len(levers), 6, 6))
    maps[:, :3, :3] = maps[:, 3:, 3:] = axes
    maps[:, 3:, :3] = np.cross(levers[:, :, None], axes, axis=1)
    return maps
