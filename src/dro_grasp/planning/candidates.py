"""Grasps to plan for: palms that look down at the object, or from above to one side, the best score first."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.geometry.point_clouds import even_directions
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.pipeline.problem import GraspProblem
from dro_grasp.pipeline.proposal import propose
from dro_grasp.pipeline.stages import complete, rank, refine
from dro_grasp.predictor import GraspPredictor

Directions = Literal["paper", "all"]
"""Palm directions that are asked for."""
PAPER_DIRECTIONS = 32
"""Palm directions of the paper, from above to the right side."""
LOWEST = 0.35
"""Largest upward component of a palm direction that a table leaves room for (ours)."""
SPREAD = 16
"""Directions of `all` that are asked for, at most (ours)."""
CLEAR = 0.006
"""Height above the table to which the lowest point of a raised hand is brought [m] (ours)."""
LARGEST_RAISE = 0.03
"""Most that a grasp is raised at once [m]; farther, the fingers would lose the object (ours)."""
RAISES = 2
"""How often grasps are raised and refined (ours): of 64 LEAP grasps of a mug 7, then 21, then 36 stay above the table."""


def palm_directions(kind: Directions, count: int) -> Float[Tensor, "k 3"]:
    """Unit vectors in the world, at most `count`; z points up, the robot looks along x.

    Args:
        kind: `paper` goes in PAPER_DIRECTIONS steps from above to the right side, whence the palm looks to the left; `all`
            spreads over all directions from above and from the sides.
        count: How many there is use for.
    """
    if kind == "paper":
        angles = [math.pi / 2 * i / (PAPER_DIRECTIONS - 1) for i in range(PAPER_DIRECTIONS)]
        every = torch.tensor([[0.0, math.sin(a), -math.cos(a)] for a in angles], dtype=torch.float64)
        return every[torch.linspace(0, len(every) - 1, min(count, len(every))).round().long()]
    share = (1 + LOWEST) / 2  # of the sphere below that height
    number = min(count, SPREAD)
    below = even_directions(math.ceil(number / share))
    return below[below[:, 2] < LOWEST][-number:]


# no_grad, not inference_mode: roma caches a tensor at first use, which training could then not use.
@torch.no_grad()
def grasps_in_world(
    predictor: GraspPredictor, problem: GraspProblem, T_world_object: Float[np.ndarray, "4 4"], num: int,
    directions: Directions = "all", table: float | None = None, seed: int = 0,
) -> GraspBatch:
    """Refined grasps with scores, the best first; their frame is the world's.

    Args:
        predictor: Its weights propose the grasps.
        problem: Hand and object.
        T_world_object: Where the object stands [m].
        num: How many.
        directions: Which palm directions.
        table: Height of a table in the world [m]: grasps that reach into it are raised and refined again.
        seed: The same seed gives the same grasps.
    """
    T = torch.from_numpy(T_world_object).float()
    wanted = palm_directions(directions, num).float() @ T[:3, :3]
    generator = torch.Generator().manual_seed(seed)
    parts = []
    for i, (x, y, z) in enumerate(wanted.tolist()):
        count = num * (i + 1) // len(wanted) - num * i // len(wanted)
        parts.append(propose(problem, predictor.network, count, generator, (x, y, z), predictor.config).grasps)
    grasps = refine(problem, GraspBatch.concatenate(parts))
    if table is not None:
        for _ in range(RAISES):
            grasps = _raised(problem, grasps, T, table)
    ranked = rank(problem, grasps)
    return ranked.replace(T_object_wrist=T @ ranked.T_object_wrist)


def lowest_points(hand: Hand, grasps: GraspBatch, T_world_object: Float[Tensor, "4 4"] | None = None) -> Float[Tensor, " n"]:
    """Height of the hand's lowest point in pregrasp, grasp and squeeze of complete grasps [m]."""
    T = grasps.T_object_wrist if T_world_object is None else T_world_object @ grasps.T_object_wrist
    postures = (grasps.pregrasp_joints, grasps.joints, grasps.squeeze_joints)
    return torch.stack([hand.points(q, T)[..., 2].amin(-1) for q in postures]).amin(0)


def _raised(problem: GraspProblem, grasps: GraspBatch, T: Float[Tensor, "4 4"], table: float) -> GraspBatch:
    """The same grasps; those that reach into the table are raised, and refined there."""
    lack = table + CLEAR - lowest_points(problem.hand, complete(problem, grasps), T)
    rows = (lack > 0).nonzero()[:, 0]
    if not len(rows):
        return grasps
    below = grasps[rows]
    wrists = below.T_object_wrist.clone()
    wrists[:, :3, 3] += lack[rows].clamp(max=LARGEST_RAISE)[:, None] * T[2, :3]
    again = refine(problem, below.moved_to(wrists, below.joints))
    return GraspBatch.concatenate([grasps[(lack <= 0).nonzero()[:, 0]], again])
