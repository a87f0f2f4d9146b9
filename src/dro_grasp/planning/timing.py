"""Paths in joint space, timed within limits of speed and acceleration (TOPP-RA)."""

from __future__ import annotations

import logging
import warnings
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from toppra.interpolator import AbstractGeometricPath

STEP = 0.01
"""Longest time between samples of a trajectory [s] (ours); each of its parts has samples at equal distances."""
USED = 0.95
"""Share of each limit that is used: they hold at points of a grid, and a motion that exceeds one between is slowed (ours)."""
SAME = 1e-6
"""Waypoints nearer to each other are one [rad or m] (ours)."""
GRID = 150
"""Least number of points of the path at which the limits hold (ours)."""


@dataclass(frozen=True)
class Trajectory:
    """Joints over time, from rest to rest."""

    time: Float[np.ndarray, " k"]
    """From zero [s]."""
    position: Float[np.ndarray, "k n"]
    """[rad or m]"""
    velocity: Float[np.ndarray, "k n"]
    """[rad/s or m/s]"""
    acceleration: Float[np.ndarray, "k n"]
    """[rad/s^2 or m/s^2]"""

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return float(self.time[-1])


def smooth(
    waypoints: Float[np.ndarray, "k n"], velocity: Float[np.ndarray, " n"], acceleration: Float[np.ndarray, " n"],
    least_seconds: float = 0.0,
) -> Trajectory:
    """The quickest motion along a cubic spline through the waypoints.

    Args:
        waypoints: Neighbours are close together [rad or m].
        velocity: Limits [rad/s or m/s].
        acceleration: Limits [rad/s^2 or m/s^2].
        least_seconds: A quicker motion is slowed down to this duration [s].
    """
    kept = [0, *(i for i in range(1, len(waypoints)) if np.abs(waypoints[i] - waypoints[i - 1]).max() > SAME)]
    points = waypoints[kept]
    if len(points) == 1:
        return standing(points[0], least_seconds)
    along = np.concatenate([[0.0], np.linalg.norm(np.diff(points, axis=0), axis=1).cumsum()])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import toppra
        from toppra import algorithm, constraint

        logging.getLogger("toppra").setLevel(logging.CRITICAL)
        limits = [constraint.JointVelocityConstraint(USED * np.stack([-velocity, velocity], 1)),
                  constraint.JointAccelerationConstraint(USED * np.stack([-acceleration, acceleration], 1))]
        path = toppra.SplineInterpolator(along, points, bc_type="natural")
        grid = np.linspace(0, along[-1], max(GRID, 3 * len(points)))
        timed = algorithm.TOPPRA(limits, path, gridpoints=grid, parametrizer="ParametrizeConstAccel").compute_trajectory(0, 0)
    if timed is None:
        raise RuntimeError("a path through its own waypoints has no timing within positive limits")
    fine = np.linspace(0, timed.duration, 4 * GRID)
    excess = [1.0, least_seconds / timed.duration, float(np.abs(timed(fine, 1) / velocity).max()),
              float(np.abs(timed(fine, 2) / acceleration).max()) ** 0.5]
    return _sampled(timed, max(excess))


def cornered(
    waypoints: Float[np.ndarray, "k n"], velocity: Float[np.ndarray, " n"], acceleration: Float[np.ndarray, " n"],
    least_seconds: float = 0.0,
) -> Trajectory:
    """The same along straight lines, with a stop at each corner: slow, and never off the path or beyond its ends.

    Args:
        waypoints: Ends and corners, and any points between them [rad or m].
        velocity: Limits [rad/s or m/s].
        acceleration: Limits [rad/s^2 or m/s^2].
        least_seconds: A quicker motion is slowed down to this duration [s]; each line gets its share by length.
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
    return Trajectory(time, np.tile(q, (len(time), 1)), still, still.copy())


def joined(parts: list[Trajectory]) -> Trajectory:
    """One trajectory after the other."""
    starts = np.concatenate([[0.0], np.cumsum([p.seconds for p in parts])])
    rows = [slice(None if i == 0 else 1, None) for i in range(len(parts))]  # each begins where the last one ended
    time = np.concatenate([p.time[r] + t for p, r, t in zip(parts, rows, starts[:-1], strict=True)])
    fields = [np.concatenate([getattr(p, name)[r] for p, r in zip(parts, rows, strict=True)])
              for name in ("position", "velocity", "acceleration")]
    return Trajectory(time, *fields)


def _sampled(timed: AbstractGeometricPath, slower: float) -> Trajectory:
    duration = float(timed.duration) * slower
    time = np.linspace(0, duration, max(2, int(np.ceil(duration / STEP)) + 1))
    position, velocity, acceleration = (timed(time / slower, order) / slower**order for order in range(3))
    velocity[[0, -1]] = 0.0
    return Trajectory(time, position, velocity, acceleration)
