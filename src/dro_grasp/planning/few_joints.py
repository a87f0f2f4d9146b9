"""Arms with fewer than six joints, which bring the wrist to few poses: whence they can grasp at all.

At a place on the table, the palms of such an arm face a few ways only, mostly those in the plane of its links. Grasps are asked
for from there, and a wrist may be turned a little from what was asked. Ours.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.geometry.point_clouds import farthest_points
from dro_grasp.planning.robot import Robot

FULL = 6
"""Joints of an arm that brings its wrist to any pose in reach."""
TURNED = 0.12
"""Farthest that a wrist is turned about the grasp centre from what was asked [rad] (ours)."""
DRAWS = 50_000
"""Random configurations among which palm directions are looked for (ours)."""
NEAREST = 64
"""Configurations whose grasp centre is nearest to the place (ours)."""
DIRECTIONS = 8
"""Palm directions that grasps are asked for from (ours)."""
STEEPEST = 0.2
"""Sine of the angle above the horizontal up to which a palm may face upwards (ours): the table is below."""


def has_few_joints(robot: Robot) -> bool:
    """Whether the arm brings its wrist to some poses only."""
    return len(robot.arm_joints) < FULL


def reachable_directions(robot: Robot, place: Float[np.ndarray, "3"], seed: int = 0) -> Float[Tensor, "k 3"]:
    """Palm directions with which the arm brings its grasp centre to a place, spread evenly.

    Args:
        robot: The robot.
        place: In the world [m].
        seed: The same seed gives the same directions.
    """
    arm = np.random.default_rng(seed).uniform(*robot.working_range, (DRAWS, len(robot.home)))
    T = torch.from_numpy(robot.T_world_wrist(arm)).float()
    away = (robot.hand.grasp_centres(T) - torch.from_numpy(place).float()).norm(dim=-1)
    directions = robot.hand.palm_directions(T)
    away = torch.where(directions[:, 2] < STEEPEST, away, torch.inf)
    near = directions[away.topk(NEAREST, largest=False).indices]
    return near[farthest_points(near, DIRECTIONS)]
