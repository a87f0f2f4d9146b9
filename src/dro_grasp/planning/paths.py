"""Collision-free paths of the arm to the first of several goals that can be reached (OMPL's RRT-Connect)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float
from ompl import base as ob, geometric as og, util as ou

RESOLUTION = 0.03
"""Largest change of a joint between two configurations that are checked on an edge [rad or m] (ours)."""
SIMPLIFY_SECONDS = 3.0
"""Longest time spent on shortening a path [s] (ours): it ends by itself long before, but on a busy machine."""
SPACING = 0.08
"""Largest change of a joint between the waypoints of a path that is returned [rad or m] (ours)."""
RANGE = 0.6
"""Longest edge of the planner's trees [rad] (ours)."""

Check = Callable[[Float[np.ndarray, " n"]], bool]
"""Whether a configuration is free."""


@dataclass(frozen=True)
class Path:
    """A path in joint space that ends at a goal."""

    waypoints: Float[np.ndarray, "k n"]
    """Densely spaced [rad or m]."""
    goal: int
    """Index of the goal that it ends at."""


def find_path(
    start: Float[np.ndarray, " n"], goals: Float[np.ndarray, "g n"], free: Check, lower: Float[np.ndarray, " n"],
    upper: Float[np.ndarray, " n"], seconds: float, seed: int,
) -> Path | None:
    """A path from the start to one of the goals, None if none is found in time.

    Args:
        start: Free configuration [rad or m].
        goals: Free configurations; the planner takes the one that it connects first, and tries them in this order.
        free: Whether a configuration is free.
        lower: Limits of the joints [rad or m].
        upper: Likewise.
        seconds: Longest time spent on planning [s].
        seed: Of OMPL's generators, which are its own.
    """
    ou.setLogLevel(ou.LOG_NONE)
    ou.RNG.setSeed(seed + 1)  # OMPL takes zero for no seed
    space = ob.RealVectorStateSpace(len(start))
    bounds = ob.RealVectorBounds(len(start))
    for i, (low, high) in enumerate(zip(lower.tolist(), upper.tolist(), strict=True)):
        bounds.setLow(i, low)
        bounds.setHigh(i, high)
    space.setBounds(bounds)
    setup = og.SimpleSetup(space)
    setup.setStateValidityChecker(lambda state: free(_array(state, len(start))))
    information = setup.getSpaceInformation()
    information.setStateValidityCheckingResolution(RESOLUTION / space.getMaximumExtent())
    setup.setStartState(_state(space, start))
    goal_set = ob.GoalStates(information)
    for goal in goals:
        goal_set.addState(_state(space, goal))
    setup.setGoal(goal_set)
    planner = og.RRTConnect(information)
    planner.setRange(RANGE)
    setup.setPlanner(planner)
    setup.solve(seconds)
    if not setup.haveExactSolutionPath():  # `solve` is content with approximate paths
        return None
    setup.simplifySolution(SIMPLIFY_SECONDS)
    corners = np.array([_array(s, len(start)) for s in setup.getSolutionPath().getStates()])
    corners[0] = start
    goal = int(np.linalg.norm(goals - corners[-1], axis=1).argmin())
    return Path(densified(corners, SPACING), goal)


def densified(corners: Float[np.ndarray, "k n"], spacing: float) -> Float[np.ndarray, "m n"]:
    """The same polyline with waypoints at most `spacing` apart, in the largest change of a joint."""
    pieces = []
    for a, b in pairwise(corners):
        count = max(1, int(np.ceil(np.abs(b - a).max() / spacing)))
        pieces.append(a + np.linspace(0, 1, count, endpoint=False)[:, None] * (b - a))
    return np.concatenate([*pieces, corners[-1:]])


def _state(space: ob.RealVectorStateSpace, q: Float[np.ndarray, " n"]) -> Any:
    state: Any = space.allocState()
    for i, value in enumerate(q.tolist()):
        state[i] = value
    return state


def _array(state: Any, n: int) -> Float[np.ndarray, " n"]:
    return np.array([state[i] for i in range(n)])
