"""Grasps to plan for: above the table, from all directions or from above to the right side, the best score first."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.devices import fast_products, side_by_side
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.pipeline.constraints import Constraints
from dro_grasp.pipeline.problem import GraspProblem
from dro_grasp.pipeline.proposal import propose
from dro_grasp.pipeline.stages import optimise, refine, scored
from dro_grasp.predictor import OPTIMISED_IN_SURROUNDINGS, GraspPredictor

Directions = Literal["paper", "all"]
"""Palm directions that are asked for."""
PAPER_DIRECTIONS = 32
"""Palm directions of the paper, from above to the right side."""
KNOWN = 0.0
"""Log-odds of holding above which a grasp is likelier to hold than not."""
KNOWN_SHARE = 0.25
"""Share of the network's grasps that should be, or the optimiser makes rivals for what is lacking (ours)."""
PARTS = 2
"""Parts that grasps from all directions are made in, side by side where there are cores (ours)."""


def paper_directions(count: int) -> Float[Tensor, "k 3"]:
    """Unit vectors in the world, at most `count`: from above to the right side, whence the palm looks to the left.

    z points up, and the robot looks along x.
    """
    angles = torch.linspace(0, math.pi / 2, PAPER_DIRECTIONS)
    every = torch.stack([torch.zeros_like(angles), angles.sin(), -angles.cos()], 1)
    return every[torch.linspace(0, len(every) - 1, min(count, len(every))).round().long()]


def grasps_in_world(
    predictor: GraspPredictor, hand: Hand, obj: ObjectModel, T_world_object: Float[np.ndarray, "4 4"], num: int,
    wanted: Constraints, directions: Directions | Float[Tensor, "k 3"] = "all", seed: int = 0,
) -> GraspBatch:
    """Refined grasps with scores, the best first; their frame is the world's.

    Where the score says that the network does not know the hand or the object, the optimiser adds candidates.

    Args:
        predictor: Its weights propose the grasps.
        hand: The hand.
        obj: What is grasped; its z axis points up.
        T_world_object: Where it stands [m].
        num: How many.
        wanted: What they have to respect, in the world's frame.
        directions: Which palm directions, where none is wanted; unit vectors in the world if they are given.
        seed: The same seed gives the same grasps.
    """
    T = torch.from_numpy(T_world_object).float()
    wanted = wanted.moved(np.linalg.inv(T_world_object))
    problem = GraspProblem(hand, obj, predictor.device, wanted)
    problem.field  # noqa: B018  (made once, with what is to be avoided, before the threads share it)
    parts = [problem] * min(num, PARTS)
    if not isinstance(directions, str) or directions == "paper":
        asked = paper_directions(num) if isinstance(directions, str) else directions[:num]
        parts = [replace(problem, constraints=replace(wanted, direction=(x, y, z))) for x, y, z in (asked @ T[:3, :3]).tolist()]
    seeds = np.random.default_rng(seed).integers(2**31, size=len(parts)).tolist()

    # no_grad, not inference_mode: roma caches a tensor at first use, which training could then not use.
    @torch.no_grad()
    def made(i: int) -> GraspBatch:
        problem = parts[i]
        count = num * (i + 1) // len(parts) - num * i // len(parts)
        generator = torch.Generator().manual_seed(seeds[i])
        proposed = propose(problem, predictor.network, count, generator, predictor.config).grasps
        grasps = scored(problem, refine(problem, proposed))
        lacking = math.ceil(KNOWN_SHARE * count) - int((grasps.score > KNOWN).sum())
        if lacking <= 0:
            return grasps
        rivals = scored(problem, refine(problem, optimise(problem, OPTIMISED_IN_SURROUNDINGS * lacking, seeds[i]).grasps))
        return GraspBatch.concatenate([grasps, rivals]).sorted_by_score()[:count]

    with fast_products():
        ranked = GraspBatch.concatenate(side_by_side(made, range(len(parts)))).sorted_by_score()
    return ranked.replace(T_object_wrist=T @ ranked.T_object_wrist)


def lowest_points(hand: Hand, grasps: GraspBatch) -> Float[Tensor, " n"]:
    """Height of the hand's lowest point in pregrasp, grasp and squeeze of complete grasps [m]."""
    postures = (grasps.pregrasp_joints, grasps.joints, grasps.squeeze_joints)
    return torch.stack([hand.points(q, grasps.T_object_wrist)[..., 2].amin(-1) for q in postures]).amin(0)
