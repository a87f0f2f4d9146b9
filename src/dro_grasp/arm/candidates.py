"""Grasps to plan for: above the table, from all directions or from above to the right side, the best score first."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.devices import side_by_side
from dro_grasp.errors import NoGraspError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.config import GraspRequest
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem

Directions = Literal["paper", "all"]  # Palm directions that are asked for
PAPER_DIRECTIONS = 32  # Palm directions of the paper, from above to the right side

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

    Args:
        predictor: Proposes and finishes the grasps.
        hand: The hand.
        obj: What is grasped; its z axis points up.
        T_world_object: Where it stands [m].
        request: How many, of which source, from which seed.
        wanted: What they have to respect, in the world's frame.
        directions: Which palm directions, where none is wanted; unit vectors in the world if they are given. Each of them gets
            a request of its own, with its share of the grasps.
    """
    T = torch.from_numpy(T_world_object).float()
    problem = GraspProblem(hand, obj, predictor.device, wanted.moved(np.linalg.inv(T_world_object)))
    problems, requests = [problem], [request]
    if not isinstance(directions, str) or directions == "paper":
        asked = paper_directions(request.num) if isinstance(directions, str) else directions[:request.num]
        problems = [replace(problem, constraints=replace(problem.constraints, direction=(x, y, z)))
                    for x, y, z in (asked @ T[:3, :3]).tolist()]
        seeds = np.random.default_rng(request.seed).integers(2**31, size=len(problems)).tolist()
        shares = [request.num * (i + 1) // len(problems) - request.num * i // len(problems) for i in range(len(problems))]
        requests = [replace(request, num=num, seed=seed) for num, seed in zip(shares, seeds, strict=True)]

    def made(problem: GraspProblem, request: GraspRequest) -> GraspBatch | None:
        try:
            return predictor.run(problem, request).grasps
        except NoGraspError:
            return None

    # Alone, a request uses all threads itself.
    parts = side_by_side(made, problems, requests) if len(problems) > 1 else [made(problem, request)]
    found = [grasps for grasps in parts if grasps is not None]
    if not found:
        return GraspBatch.none(hand, obj)
    ranked = GraspBatch.concatenate(found).sorted_by_score()
    return ranked.replace(T_object_wrist=T @ ranked.T_object_wrist)


def lowest_points(hand: Hand, grasps: GraspBatch) -> Float[Tensor, " n"]:
    """Height of the hand's lowest point in pregrasp, grasp and squeeze of complete grasps [m]."""
    postures = (grasps.pregrasp_joints, grasps.joints, grasps.squeeze_joints)
    return torch.stack([hand.points(q, grasps.T_object_wrist)[..., 2].amin(-1) for q in postures]).amin(0)
