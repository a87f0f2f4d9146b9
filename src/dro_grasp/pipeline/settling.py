"""Settling: the closing of the hand is simulated until it leaves the object where it is.

In contact simulation, fingers and object find the places that geometry alone gets wrong by millimetres. No force is tried on
the object, so this is no trial; it needs the mesh and the hand's description. Ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.geometry.rotations import roma
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.optimization.grip import gripping
from dro_grasp.optimization.refinement import RefineConfig
from dro_grasp.pipeline.problem import GraspProblem
from dro_grasp.pipeline.stages import complete, permitted, refine, scored
from dro_grasp.simulation.trial import settle

SHARE = 0.5
"""Share of scored candidates that are settled, the best ones (ours)."""
ESCAPED_SCORE = -4.0
"""Highest score of a grasp that loses the object when its closing is simulated [log-odds of holding] (ours)."""


@dataclass(frozen=True)
class SettleConfig:
    """What counts as holding still while the hand closes (ours)."""

    still: float = 0.005
    """A grasp that moves the object less than this has settled; others are refined where they stand, and close again [m]."""
    lost: float = 0.05
    """An object that moves farther than this is lost [m]."""
    farthest: float = 0.02
    """How far it may move the second time [m]."""
    largest_turn: float = math.radians(30)
    """How far it may turn then [rad]."""
    refinement: RefineConfig = field(default_factory=RefineConfig)
    """How grasps are refined between the two closings, and how settled ones squeeze."""


def can_settle(problem: GraspProblem) -> bool:
    """Whether the closing can be simulated: on a mesh, with a hand that has its description."""
    return problem.hand.description is not None and not problem.obj.is_cloud


def best_settled(problem: GraspProblem, grasps: GraspBatch, least: int) -> tuple[Int[Tensor, " k"], GraspBatch]:
    """The better half of scored grasps, settled and scored again, in their order; which rows they are comes first.

    A grasp that loses the object when it closes, or ends where the problem's constraints forbid, stays as it was and scores
    at most ESCAPED_SCORE.

    Args:
        problem: Hand and object; see `can_settle`.
        grasps: Refined grasps with scores.
        least: Settle as many at least, where there are.
    """
    count = max(round(SHARE * len(grasps)), min(len(grasps), least))
    best = grasps.score.topk(count).indices.sort().values
    closed, held = settled(problem, grasps[best])
    wrong = ~permitted(problem, closed)
    closed, held = replaced(closed, wrong, grasps[best[wrong]]), held & ~wrong
    score = scored(problem, closed).score
    return best, closed.replace(score=torch.where(held, score, score.clamp_max(ESCAPED_SCORE)))


def settled(
    problem: GraspProblem, grasps: GraspBatch, config: SettleConfig | None = None
) -> tuple[GraspBatch, Bool[Tensor, " n"]]:
    """Grasps where closing leaves them, and which of them hold still.

    Each hand closes once. Where the object moves, the grasp that comes out is refined and closes again. A grasp that still
    moves the object, or loses it at once, is returned as it was.

    Args:
        problem: Hand and object; see `can_settle`.
        grasps: Refined grasps of the two, with or without pregrasp and squeeze.
        config: Limits.

    Raises:
        ObjectError: The object is a bare point cloud.
        HandError: The hand came without its description.
    """
    config, hand = config or SettleConfig(), problem.hand
    grasps = complete(problem, grasps.without("score"))
    if not len(grasps):
        return grasps, torch.zeros(0, dtype=torch.bool)
    closed = settle(hand, problem.obj, grasps)
    moved, _ = motion(hand, grasps, closed)
    held = moved < config.still
    grasps = replaced(grasps, held, gripping(problem.energy(config.refinement.energy), closed[held], config.refinement.grip))
    again = (~held & (moved < config.lost)).nonzero()[:, 0]
    better = refine(problem, closed[again], config.refinement)
    moved, turned = motion(hand, better, settle(hand, problem.obj, better))
    holds = (moved < config.farthest) & (turned < config.largest_turn)
    rows = torch.zeros_like(held).index_fill(0, again[holds], True)
    return replaced(grasps, rows, better[holds]), held | rows


def replaced(grasps: GraspBatch, rows: Bool[Tensor, " n"], others: GraspBatch) -> GraspBatch:
    """The batch with other poses, joints and targets in these rows."""
    values = {}
    for name in ("T_object_wrist", "joints", "pregrasp_joints", "squeeze_joints"):
        values[name] = getattr(grasps, name).clone()
        values[name][rows] = getattr(others, name)
    return grasps.bare().replace(**values)


def motion(hand: Hand, before: GraspBatch, after: GraspBatch) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """How far the hand moved relative to the object [m], at the grasp centre, and turned [rad]."""
    T, new = before.T_object_wrist, after.T_object_wrist
    shift = (hand.grasp_centres(new) - hand.grasp_centres(T)).norm(dim=-1)
    return shift, torch.as_tensor(roma.rotmat_geodesic_distance(T[:, :3, :3], new[:, :3, :3]))
