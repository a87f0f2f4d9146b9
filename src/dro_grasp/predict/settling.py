"""Settling: the closing of the hand is simulated until it leaves the object where it is.

In contact simulation, fingers and object find the places that geometry alone gets wrong by millimetres. No force is tried on
the object, so this is no trial; it needs the hand's description. Balls stand for a bare cloud. Ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.kinds import Checked, renamed
from dro_grasp.optimize.fingers import missing_clearance
from dro_grasp.optimize.grasp_energy import EnergyConfig
from dro_grasp.optimize.refinement import RefineConfig
from dro_grasp.predict.admission import AdmissionConfig, feasible
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.score.score import ScoreConfig, holding_score
from dro_grasp.predict.stages import complete, grip, refine, scored
from dro_grasp.simulation.contacts import deepest_penetration
from dro_grasp.simulation.grasp_state import GraspState, WeightConfig, grasp_state
from dro_grasp.simulation.trial import hand_shift, settle


@renamed(room_worth="clearance_worth")
@dataclass(frozen=True)
class SettleConfig(Checked):
    """Which grasps settle, what counts as holding still while the hand closes, and what that means for the score (ours)."""

    share: float = 0.5
    """Share of scored candidates that are settled, the best ones; the others are left out."""
    clearance_worth: float = 80.0
    """What the score of a grasp on an object seen in part loses for clearance that the opened hand lacks [log-odds per m]."""
    unstable_score: float = -4.0
    """Highest score of a grasp that does not hold still when its closing is simulated [log-odds of holding]."""
    still: float = 0.005
    """A grasp that moves the object less than this has settled; others are refined where they stand, and close again [m]."""
    lost: float = 0.05
    """An object that moves farther than this is lost [m]."""
    farthest: float = 0.02
    """How far it may move the second time [m]."""
    largest_turn: float = math.radians(30)
    """How far it may turn then [rad]."""
    deepest: float = 0.005
    """How deep the hand may be, before it closes, in the object or in itself [m]; fingers that cross hold nothing."""
    protocol: str = "carry"
    """Physics of the second closing, and of the pulls after it."""
    giving_worth: float = 3.0
    """What the score loses where the weight moves or turns the object as far as it may [log-odds]."""
    lifted: float = 0.6
    """What lies flat on a table is lifted if the weight then moves or turns it by no larger share of what it may."""
    lifting: float = 1.0
    """Time of each pull on it [s], as in a trial: pinches turn slowly."""
    weight: WeightConfig = field(default_factory=WeightConfig)
    """How hard settled grasps press for the object's weight."""
    refinement: RefineConfig = field(default_factory=RefineConfig)
    """How grasps are refined between the two closings, and how settled ones squeeze."""


GIVES, TURNS = 0.02, math.radians(15)
"""How far a load may move [m] and turn [rad] what is held. Ours: as under `carry`."""


def giving(state: GraspState) -> Float[Tensor, " n"]:
    """How far the weight moves or turns the object, of what it may; 0 where it was not tried, at most 2."""
    share = torch.maximum(state.gave[:, 0] / GIVES, state.gave[:, 1] / TURNS)
    return share.nan_to_num(0.0).clamp_max(2.0)


class Settled(NamedTuple):
    """What became of n grasps, m of which hold still."""

    grasps: GraspBatch  # all of them, in their order
    stable: Bool[Tensor, " n"]  # which ones hold still, with no link too deep in the object or in another
    state: GraspState  # how these m hold the object


def can_settle(problem: GraspProblem) -> bool:
    """Whether the closing can be simulated: with a hand that has its description."""
    return problem.hand.description is not None


def settle_best(
    problem: GraspProblem, grasps: GraspBatch, least: int, config: SettleConfig | None = None,
    score: ScoreConfig | None = None, admission: AdmissionConfig | None = None,
) -> tuple[Int[Tensor, " k"], GraspBatch, int]:
    """The better share of scored grasps, settled and scored again, in their order; which rows they are comes first.

    Of what lies flat on a table, grasps that do not lift it are left out; how many comes last.

    The score counts how the object is held then, and on an object seen in part the clearance that the opened hand leaves. A
    grasp that does not hold still, or ends where the problem's constraints forbid, stays as it was and scores at most
    `unstable_score`.

    Args:
        problem: Hand and object; see `can_settle`.
        grasps: Refined grasps with scores.
        least: Settle as many at least, where there are.
        config: Which grasps settle, and what becomes of their scores.
        score: How grasps are scored.
        admission: What the constraints let pass.
    """
    config = config or SettleConfig()
    # The score, which is learned from objects that hang in the air, does not tell which of several pinches lifts.
    count = len(grasps) if problem.lies_flat else max(round(config.share * len(grasps)), min(len(grasps), least))
    best = grasps.score.topk(count).indices.sort().values
    closed, stable, state = settle_grasps(problem, grasps[best], config)
    wrong = ~feasible(problem, closed, admission)
    closed = replaced(closed, wrong, grasps[best[wrong]])
    found = scored(problem, closed, score).score
    held = holding_score(found[stable], state)
    # What gives way under its weight is still better than what does not even hold still.
    found[stable] = torch.maximum(held - config.giving_worth * giving(state), config.unstable_score + held.sigmoid())
    found = torch.where(stable & ~wrong, found, found.clamp_max(config.unstable_score))
    if problem.obj.seen is not None:
        found = found - config.clearance_worth * missing_clearance(problem.energy(EnergyConfig()), closed, problem.obj.seen)
    closed = closed.replace(score=found)
    if not problem.lies_flat:
        return best, closed, 0
    lifted = stable.index_put((stable.nonzero()[:, 0],), giving(state) < config.lifted) & ~wrong
    return best[lifted], closed[lifted], int((~lifted).sum())


def settle_grasps(problem: GraspProblem, grasps: GraspBatch, config: SettleConfig | None = None) -> Settled:
    """Grasps where closing leaves them, and which of them hold still.

    Each hand closes twice. Where the object hardly moves the first time, the grasp that comes out squeezes with balanced
    forces; where it moves, the grasp is refined there. A grasp that then still moves the object, loses it at once, or lets
    links penetrate too deep is returned as it was.

    Args:
        problem: Hand and object; see `can_settle`.
        grasps: Refined grasps of the two, with or without pregrasp and squeeze.
        config: Limits.

    Raises:
        HandError: The hand came without its description.
    """
    config, hand, obj = config or SettleConfig(), problem.hand, problem.solid
    grasps = problem.on_table(complete(problem, grasps.without("score")))
    closed = settle(hand, obj, grasps)
    moved = hand_shift(hand, grasps, closed)
    still, near = moved < config.still, moved < config.lost
    again, rows = near & ~still, near.nonzero()[:, 0]
    if problem.lies_flat:
        better = as_before(closed, grasps)[rows]
    else:
        better = replaced(closed, still, grip(problem, closed[still], config.refinement))
        better = replaced(better, again, refine(problem, closed[again], config.refinement))[rows]
    better = problem.on_table(better)
    weight = replace(config.weight, pulling=config.lifting) if problem.lies_flat else config.weight
    state, squeeze = grasp_state(hand, obj, better, config.protocol, config=weight)
    depth = deepest_penetration(hand, obj, better)
    holds = (state.shift < config.farthest) & (state.turn < config.largest_turn) & (depth < config.deepest)
    stable = torch.zeros_like(still).index_fill(0, rows[holds], True)
    better = better.replace(squeeze_joints=squeeze)
    return Settled(replaced(grasps, stable, better[holds]), stable, state.rows(holds))


def as_before(closed: GraspBatch, grasps: GraspBatch) -> GraspBatch:
    """Closed grasps that open and press by as much as the grasps that they were.

    What lies flat is thinner than the distances know that refinement goes by: it would move fingers off what they found.
    """
    postures = {name: closed.joints + getattr(grasps, name) - grasps.joints for name in ("pregrasp_joints", "squeeze_joints")}
    return closed.replace(**postures)


def replaced(grasps: GraspBatch, rows: Bool[Tensor, " n"], others: GraspBatch) -> GraspBatch:
    """The batch with other poses, joints and targets in these rows."""
    values = {}
    for name in ("T_object_wrist", "joints", "pregrasp_joints", "squeeze_joints"):
        values[name] = getattr(grasps, name).clone()
        values[name][rows] = getattr(others, name)
    return grasps.poses_only().replace(**values)
