"""Grasps to plan for: above the table, from all directions or from above to the right side, the best score first."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.devices import fast_products, side_by_side
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.scenery import load_scene
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.pipeline.constraints import Constraints
from dro_grasp.pipeline.problem import GraspProblem
from dro_grasp.pipeline.proposal import propose
from dro_grasp.pipeline.stages import refine, scored
from dro_grasp.predictor import GraspPredictor

Directions = Literal["paper", "all"]
"""Palm directions that are asked for."""
PAPER_DIRECTIONS = 32
"""Palm directions of the paper, from above to the right side."""
PARTS = 2
"""Parts that grasps from all directions are made in, side by side where there are cores (ours)."""


def paper_directions(count: int) -> Float[Tensor, "k 3"]:
    """Unit vectors in the world, at most `count`: from above to the right side, whence the palm looks to the left.

    z points up, and the robot looks along x.
    """
    angles = torch.linspace(0, math.pi / 2, PAPER_DIRECTIONS)
    every = torch.stack([torch.zeros_like(angles), angles.sin(), -angles.cos()], 1)
    return every[torch.linspace(0, len(every) - 1, min(count, len(every))).round().long()]


@dataclass(frozen=True)
class Around:
    """What the hand stays clear of, in the world."""

    table: float | None = None
    """Height of a table, which the hand stays above [m]."""
    obstacles: Sequence[ObjectModel] = ()
    """Further things."""


def grasps_in_world(
    predictor: GraspPredictor, hand: Hand, obj: ObjectModel, T_world_object: Float[np.ndarray, "4 4"], num: int,
    directions: Directions = "all", around: Around = Around(), seed: int = 0,
) -> GraspBatch:
    """Refined grasps with scores, the best first; their frame is the world's.

    Args:
        predictor: Its weights propose the grasps.
        hand: The hand.
        obj: What is grasped; its z axis points up.
        T_world_object: Where it stands [m].
        num: How many.
        directions: Which palm directions.
        around: What the hand stays clear of.
        seed: The same seed gives the same grasps.
    """
    T = torch.from_numpy(T_world_object).float()
    height = None if around.table is None else around.table - float(T[2, 3])
    wanted = [None] * min(num, PARTS) if directions == "all" else [
        (x, y, z) for x, y, z in (paper_directions(num) @ T[:3, :3]).tolist()]
    avoid = None
    if around.obstacles:
        scene = load_scene(np.concatenate([thing.cloud for thing in around.obstacles]), "obstacles")
        avoid = scene.moved(np.linalg.inv(T_world_object))
    seeds = np.random.default_rng(seed).integers(2**31, size=len(wanted)).tolist()

    # no_grad, not inference_mode: roma caches a tensor at first use, which training could then not use.
    @torch.no_grad()
    def made(i: int) -> GraspBatch:
        problem = GraspProblem(hand, obj, predictor.device, Constraints(wanted[i], height, avoid=avoid))
        count = num * (i + 1) // len(wanted) - num * i // len(wanted)
        generator = torch.Generator().manual_seed(seeds[i])
        proposed = propose(problem, predictor.network, count, generator, predictor.config).grasps
        return scored(problem, refine(problem, proposed))

    obj.distance_field  # noqa: B018  (made once, before the threads share it)
    with fast_products():
        ranked = GraspBatch.concatenate(side_by_side(made, range(len(wanted)))).sorted_by_score()
    return ranked.replace(T_object_wrist=T @ ranked.T_object_wrist)


def lowest_points(hand: Hand, grasps: GraspBatch) -> Float[Tensor, " n"]:
    """Height of the hand's lowest point in pregrasp, grasp and squeeze of complete grasps [m]."""
    postures = (grasps.pregrasp_joints, grasps.joints, grasps.squeeze_joints)
    return torch.stack([hand.points(q, grasps.T_object_wrist)[..., 2].amin(-1) for q in postures]).amin(0)
