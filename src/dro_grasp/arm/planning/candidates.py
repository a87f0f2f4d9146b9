"""Predicted grasps of what a robot has before it, in the world's frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.arm.planning.reachability import reachable_directions
from dro_grasp.arm.planning.task import Directions, Task
from dro_grasp.arm.planning.workcell import OBSTACLE
from dro_grasp.devices import fast_products, side_by_side
from dro_grasp.errors import NoGraspError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import TABLE
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.scenery import load_scene
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.config import GraspRequest
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem

PLACE = ("table", "obstacles")  # Constraints that are the robot's and the scene's
PAPER_DIRECTIONS = 32  # Palm directions of the paper, from above to the right side


def predicted(task: Task, predictor: GraspPredictor) -> Callable[[int], Iterator[GraspBatch]]:
    """What makes the grasps of a batch, in the world's frame, as they become known."""
    directions: Directions | Float[Tensor, "k 3"] = task.config.directions
    if directions == "all" and task.constraints.direction is None and task.robot.has_few_joints:
        middle = task.T[:3, :3] @ task.obj.cloud.mean(0) + task.T[:3, 3]
        directions = reachable_directions(task.robot, middle, task.seed)
    clouds = [thing.cloud for thing in task.cell.obstacles]
    obstacles = load_scene(np.concatenate(clouds), OBSTACLE) if clouds else None
    config, hand, obj, T = task.config, task.robot.hand, task.obj, task.T

    def coming(batch: int) -> Iterator[GraspBatch]:
        wanted = replace(task.wanted(batch), table=task.height, obstacles=obstacles)
        request = GraspRequest(
            config.num, task.seed_of(batch), config.candidates, source=config.source,
            least_confidence=task.least_confidence(batch))
        if isinstance(directions, str) and directions == "all":
            problem = GraspProblem(hand, obj, predictor.device, wanted.moved(np.linalg.inv(T)), PLACE)
            yield from (in_world(grasps, T) for grasps in predictor.rounds(problem, request))
        else:
            yield grasps_in_world(predictor, hand, obj, T, request, wanted, directions)

    return coming


def paper_directions(count: int) -> Float[Tensor, "k 3"]:
    """Unit vectors in the world, at most `count`: from above to the right side, whence the palm looks to the left.

    z points up, and the robot looks along x.
    """
    angles = torch.linspace(0, math.pi / 2, PAPER_DIRECTIONS)
    every = torch.stack([torch.zeros_like(angles), angles.sin(), -angles.cos()], 1)
    return every[torch.linspace(0, len(every) - 1, min(count, len(every))).round().long()]


def grasps_in_world(
    predictor: GraspPredictor, hand: Hand, obj: ObjectModel, T_world_object: Float[np.ndarray, "4 4"], request: GraspRequest,
    wanted: Constraints, directions: Directions | Float[Tensor, "k 3"] = "all",
) -> GraspBatch:
    """Grasps as the predictor returns them for the same request and constraints, the best first; their frame is the world's.

    The object's z axis points up, and constraints are in the world's frame. Where these want no palm direction, each of those
    that are given, unit vectors in the world, gets a request of its own, with its share of the grasps. NoGraspError if none of
    them finds any.
    """
    T = torch.from_numpy(T_world_object).float()
    problem = GraspProblem(hand, obj, predictor.device, wanted.moved(np.linalg.inv(T_world_object)), PLACE)
    problems, requests = [problem], [request]
    if not isinstance(directions, str) or directions == "paper":
        asked = paper_directions(request.num) if isinstance(directions, str) else directions[:request.num]
        problems = [replace(problem, constraints=replace(problem.constraints, direction=(x, y, z)))
                    for x, y, z in (asked @ T[:3, :3]).tolist()]
        seeds = np.random.default_rng(request.seed).integers(2**31, size=len(problems)).tolist()
        shares = [request.num * (i + 1) // len(problems) - request.num * i // len(problems) for i in range(len(problems))]
        requests = [replace(request, num=num, seed=seed) for num, seed in zip(shares, seeds, strict=True)]

    def made(problem: GraspProblem, request: GraspRequest) -> GraspBatch | NoGraspError:
        try:
            return predictor.run(problem, request).grasps
        except NoGraspError as error:  # other directions may have some
            return error

    if len(problems) == 1:  # it uses all threads itself
        parts = [made(problems[0], request)]
    else:
        with fast_products():
            parts = side_by_side(made, problems, requests)
    found = [part for part in parts if isinstance(part, GraspBatch)]
    if not found:
        raise next(part for part in parts if isinstance(part, NoGraspError))
    return in_world(GraspBatch.concatenate(found).sorted_by_score(), T_world_object)


def in_world(grasps: GraspBatch, T_world_object: Float[np.ndarray, "4 4"]) -> GraspBatch:
    """Grasps of an object that stands here [m]."""
    further = {name: column for name, column in grasps.extra.items() if name != TABLE}  # which is of the frame left behind
    T = torch.from_numpy(T_world_object).float()
    return grasps.replace(T_object_wrist=T @ grasps.T_object_wrist, extra=further)
