"""Settling: the closing of the hand is simulated until it leaves the object where it is.

In contact simulation, fingers and object find the places that geometry alone gets wrong by millimetres, and the weight then
pulls at the object as in a trial under `carry`, for a fifth of the time. Needs the hand's description. Balls stand for a bare
cloud. Ours.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.devices import on_accelerator
from dro_grasp.geometry.contact_forces import GRAVITY
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import CARRYING, PER_JOINT
from dro_grasp.hands.effort import find_efforts
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import Checked
from dro_grasp.optimize.fingers import missing_clearance
from dro_grasp.optimize.grasp_energy import EnergyConfig
from dro_grasp.optimize.refinement import RefineConfig
from dro_grasp.predict.admission import AdmissionConfig, feasible
from dro_grasp.predict.lifting import LiftConfig, lifted
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.score.holding import Evidence, gives_way, holding_score
from dro_grasp.predict.score.score import ScoreConfig
from dro_grasp.predict.stages import complete, grip_all, refine_all, score_all
from dro_grasp.simulation.contacts import deepest_penetration
from dro_grasp.simulation.grasp_state import GraspState, Squeeze, WeightConfig, grasp_state_many, in_turn, pressed_many
from dro_grasp.simulation.protocols import Protocol, protocol as find_protocol
from dro_grasp.simulation.trial import hand_shift, settle_many
from dro_grasp.simulation.weighing import LESS, WeighingConfig, observed, weigh_many

AWAY = "push it away as they close"  # The object is lost at the first closing
DEEP = "reach into it"  # The hand is too deep in the object, or in itself
JAMMED = "jam it between parts that do not move"  # No torque of the joints explains how hard it is pressed
MOVES = "move it as they close"  # The second closing moves the object too far
TURNS = "turn it as they close"  # It turns it too far
HARSH = "press it harder than max_force"  # A link presses harder than the constraints allow
FORBIDDEN = "end where the constraints forbid"  # What closing left violates a constraint
GIVES_WAY = "give way under its weight"  # The weight then moves or turns the object farther than the protocol allows
DOUBTS = (AWAY, DEEP, JAMMED, MOVES, TURNS, HARSH, FORBIDDEN, GIVES_WAY)
"""What closing shows against a grasp, in the order in which the first is told."""
WEIGHTS = 4.0  # Weights of the object by which it may be pressed without any torque (ours)
SLIGHT = 5.0  # Force that counts as nothing [N] (ours)


@dataclass(frozen=True)
class SettleConfig(Checked):
    """Which grasps settle, what counts as holding still while the hand closes, and what that means for the score (ours)."""

    share: float = 0.5
    """Share of scored candidates that are settled, the best ones; the others are left out."""
    spare: float = 1.5
    """As many at least settle for each grasp that is wanted, since a third of them does not hold."""
    clearance_worth: float = 90.0
    """What the score of a grasp on an object seen in part loses for clearance that the opened hand lacks [log-odds per m]."""
    guess_offset: float = -2.8
    """What it loses because part of the object is a guess [log-odds]; as the other two from lab/studies/seen_score.py."""
    guess_worth: float = 0.6
    """What a unit of the score is worth there."""
    still: float = 0.005
    """A grasp that moves the object less than this has settled; others are refined where they stand, and close again [m]."""
    lost: float = 0.05
    """An object that moves farther than this is lost [m]."""
    farthest: float = 0.02
    """How far it may move the last time [m]."""
    largest_turn: float = math.radians(30)
    """How far it may turn then [rad]."""
    shortest_lever: float = 1 / 60
    """Shortest lever with which joints press [m]. An object that is pressed harder is jammed, as a rim in a cleft of the hand,
    which only soft contacts allow: usual grasps press with 5 to 20 cm, jammed ones with less than 4 mm."""
    deepest: float = 0.005
    """How deep the hand may be, before it closes, in the object or in itself [m]; fingers that cross hold nothing."""
    unstable_score: float = -3.0
    """Highest score of a grasp that does not settle; a twentieth of them would hold [log-odds of holding]."""
    closing: str = "strict"
    """Physics of the first closing, which says where a grasp ends: fingers as strong as each other."""
    protocol: str = "carry"
    """Physics of the later closings, and of the pulls after them."""
    lifting: float = 1.0
    """Time of each pull on what lies flat on a table [s], as in a trial: pinches turn slowly."""
    weight: WeightConfig = field(default_factory=WeightConfig)
    """How hard settled grasps press for the object's weight."""
    payloads: bool = True
    """Whether payloads of settled grasps are predicted, which takes time."""
    lift: LiftConfig = field(default_factory=LiftConfig)
    """Which squeezes are tried on what lies flat on a table."""
    refinement: RefineConfig = field(default_factory=RefineConfig)
    """How grasps are refined after the first closing, and how settled ones squeeze."""


def weight_config(problem: GraspProblem, config: SettleConfig) -> WeightConfig:
    """How hard grasps press, as the problem asks."""
    asked = problem.constraints
    given = {"margin": asked.margin, "max_force": asked.max_force, "pulling": config.lifting if problem.lies_flat else None}
    return replace(config.weight, **{name: value for name, value in given.items() if value is not None})


def physics(config: SettleConfig, device: str) -> Protocol:
    """Physics of the later closings on a device: there, what is left of slip is not removed, one contact after the other.

    That takes a device long. Pulls are too short for it to show: 144 of 144 stored grasps of three hands give way, or do not,
    as with it. Trials of a second need it: 36 of 40 of one hand end as with it.
    """
    rules = find_protocol(config.protocol)
    return replace(rules, noslip=0) if on_accelerator(device) else rules


class Settled(NamedTuple):
    """What became of n grasps."""

    grasps: GraspBatch  # all of them, in their order
    stable: Bool[Tensor, " n"]  # which ones hold still, with no link too deep in the object or in another
    known: Evidence  # what closing showed of all of them
    against: dict[str, Bool[Tensor, " n"]]  # which ones are JAMMED or HARSH


def can_settle(problem: GraspProblem) -> bool:
    """Whether the closing can be simulated: with a hand that has its description."""
    return problem.hand.description is not None


class SettledBest(NamedTuple):
    """The better share of n grasps."""

    rows: Int[Tensor, " k"]  # which of the n they are
    grasps: GraspBatch  # settled, with scores
    doubts: tuple[str, ...]  # what closing showed against each, in words of DOUBTS; empty for nothing


def settle_best_all(
    problems: Sequence[GraspProblem], batches: Sequence[GraspBatch], least: int, config: SettleConfig | None = None,
    score: ScoreConfig | None = None, admission: AdmissionConfig | None = None,
) -> list[SettledBest]:
    """The better share of scored grasps, settled and scored again, in their order; several objects together on a device.

    The score counts what closing showed, and on an object seen in part the clearance that the opened hand leaves. A grasp that
    does not hold still, or ends where the problem's constraints forbid, stays as it was and scores at most `unstable_score`.

    Args:
        problems: One hand, and objects; see `can_settle`.
        batches: Refined grasps of each with scores.
        least: Settle `spare` times as many at least, where there are.
        config: Which grasps settle, and what becomes of their scores.
        score: How grasps are scored.
        admission: What the constraints let pass.
    """
    config = config or SettleConfig()
    chosen = [_better_share(*each, least, config) for each in zip(problems, batches, strict=True)]
    some = [grasps[best] for grasps, best in zip(batches, chosen, strict=True)]
    settled = settle_all(problems, some, config)
    wrong = [~feasible(problem, own.grasps, admission) for problem, own in zip(problems, settled, strict=True)]
    closed = [replaced(own.grasps, off, before[off]) for own, off, before in zip(settled, wrong, some, strict=True)]
    known = score_all(problems, closed, score)
    return [SettledBest(best, _judged_by(problem, grasps, own, off, config), doubts(own.known, off, own.against, config))
            for problem, best, grasps, own, off in zip(problems, chosen, known, settled, wrong, strict=True)]


def _better_share(problem: GraspProblem, grasps: GraspBatch, least: int, config: SettleConfig) -> Int[Tensor, " k"]:
    """Rows of the grasps that are settled."""
    # The score, which is learned from objects that hang in the air, does not tell which of several pinches lifts.
    fewest = min(len(grasps), math.ceil(config.spare * least))
    count = len(grasps) if problem.lies_flat else max(round(config.share * len(grasps)), fewest)
    return grasps.score.topk(count).indices.sort().values


def _judged_by(
    problem: GraspProblem, closed: GraspBatch, settled: Settled, wrong: Bool[Tensor, " n"], config: SettleConfig
) -> GraspBatch:
    """Scored grasps with the score that counts what closing showed."""
    stable = settled.stable & ~wrong
    found = holding_score(closed.score, replace(settled.known, stable=stable))
    found = torch.where(stable, found, found.clamp_max(config.unstable_score))
    if problem.obj.seen is not None:
        lacking = missing_clearance(problem.energy(EnergyConfig()), closed, problem.obj.seen)
        found = config.guess_offset + config.guess_worth * found - config.clearance_worth * lacking
    return closed.replace(score=found)


def doubts(
    known: Evidence, wrong: Bool[Tensor, " n"], against: dict[str, Bool[Tensor, " n"]], config: SettleConfig
) -> tuple[str, ...]:
    """What closing showed against each grasp, in words; empty for nothing."""
    state = known.state
    found = {AWAY: ~(known.moved < config.lost), DEEP: known.depth >= config.deepest, MOVES: state.shift >= config.farthest,
             TURNS: state.turn >= config.largest_turn, FORBIDDEN: wrong, GIVES_WAY: gives_way(state), **against}
    return tuple(next((words for words in DOUBTS if found[words][i]), "") for i in range(len(wrong)))


def settle_all(
    problems: Sequence[GraspProblem], batches: Sequence[GraspBatch], config: SettleConfig | None = None
) -> list[Settled]:
    """Grasps where closing leaves them, and which of them hold still; several objects together on a device.

    Each hand closes three times. Where the object hardly moves the first time, the grasp that comes out squeezes with balanced
    forces; where it moves, the grasp is refined there. The second time it gets its place, and a squeeze for the weight. A
    grasp that the last time still moves the object, loses it, presses it harder than is allowed, or lets links penetrate too
    deep is returned as it was. Payloads are of those that hold and do not give way under the weight. What lies flat on a table
    is closed on from where the grasp is, with several squeezes.

    Args:
        problems: One hand, and objects; see `can_settle`.
        batches: Refined grasps of each, with or without pregrasp and squeeze.
        config: Limits.

    Raises:
        HandError: The hand came without its description.
    """
    config = config or SettleConfig()
    whole = [problem.on_table(complete(problem, grasps.without("score"))) for problem, grasps in zip(
        problems, batches, strict=True)]
    hanging = [i for i, problem in enumerate(problems) if not problem.lies_flat or not len(batches[i])]
    done = dict(zip(hanging, _closed_thrice([problems[i] for i in hanging], [whole[i] for i in hanging], config), strict=True))
    return [done[i] if i in done else _lifted(problem, grasps, config)
            for i, (problem, grasps) in enumerate(zip(problems, whole, strict=True))]


def _closed_thrice(
    problems: Sequence[GraspProblem], whole: Sequence[GraspBatch], config: SettleConfig
) -> list[Settled]:
    """What becomes of grasps of objects that hang in the air."""
    if not problems:
        return []
    first = settle_many(problems[0].hand, [problem.solid for problem in problems], whole, config.closing,
                        device=str(problems[0].device))
    closed = [_Closed.of(*own, config) for own in zip(problems, whole, first, strict=True)]
    found: dict[int, Settled] = {}
    better = _bettered(problems, closed, config)
    for asked, numbers in _alike(problems, config):
        some = _closed_again(
            [problems[i] for i in numbers], [whole[i] for i in numbers], [closed[i].moved for i in numbers],
            [better[i] for i in numbers], asked, config)
        found |= zip(numbers, some, strict=True)
    return [found[i] for i in range(len(problems))]


def _alike(problems: Sequence[GraspProblem], config: SettleConfig) -> Iterator[tuple[WeightConfig, list[int]]]:
    """Which problems press alike, and how."""
    asked = [weight_config(problem, config) for problem in problems]
    yield from ((one, [i for i, other in enumerate(asked) if other == one]) for one in dict.fromkeys(asked))


class _Closed(NamedTuple):
    """Grasps after the first closing."""

    grasps: GraspBatch  # where it left them
    moved: Float[Tensor, " n"]  # how far it moved the object [m]
    still: Bool[Tensor, " n"]
    near: Bool[Tensor, " n"]

    @staticmethod
    def of(problem: GraspProblem, before: GraspBatch, after: GraspBatch, config: SettleConfig) -> _Closed:
        """What the closing showed."""
        moved = hand_shift(problem.hand, before, after)
        return _Closed(after, moved, moved < config.still, moved < config.lost)


def _bettered(problems: Sequence[GraspProblem], closed: Sequence[_Closed], config: SettleConfig) -> list[GraspBatch]:
    """Closed grasps that squeeze with balanced forces, or are refined where closing moved the object."""
    again = [own.near & ~own.still for own in closed]
    gripping = grip_all(problems, [own.grasps[own.still] for own in closed], config.refinement)
    refined = refine_all(problems, [own.grasps[rows] for own, rows in zip(closed, again, strict=True)], config.refinement)
    return [replaced(replaced(own.grasps, own.still, grip), rows, fine)
            for own, rows, grip, fine in zip(closed, again, gripping, refined, strict=True)]


def _closed_again(
    problems: Sequence[GraspProblem], whole: Sequence[GraspBatch], moved: Sequence[Float[Tensor, " n"]],
    better: Sequence[GraspBatch], asked: WeightConfig, config: SettleConfig,
) -> list[Settled]:
    """What becomes of better grasps as they squeeze for the weight and close once more."""
    hand, solids, device = problems[0].hand, [problem.solid for problem in problems], str(problems[0].device)
    rows = [(own < config.lost).nonzero()[:, 0] for own in moved]
    near = [problem.on_table(grasps[own]) for problem, grasps, own in zip(problems, better, rows, strict=True)]
    rules, parts = physics(config, device), in_turn([*map(len, near)])
    done = pressed_many(hand, solids, near, rules, config=asked, device=device)
    again = [problem.on_table(done.grasps[part]) for problem, part in zip(problems, parts, strict=True)]
    state, squeeze = grasp_state_many(hand, solids, again, rules, config=asked, device=device)
    payload = done.payloads(~gives_way(state) & config.payloads, asked.payload)
    return [
        _judged(problem, grasps, own, shift, found.replace(payload=payload[part]), state.rows(part), squeeze.rows(part), config)
        for problem, grasps, own, shift, found, part in zip(problems, whole, rows, moved, again, parts, strict=True)]


def _lifted(problem: GraspProblem, grasps: GraspBatch, config: SettleConfig) -> Settled:
    """Pinches of what lies flat, where they are: to close, refine and close again moves fingers off something thin."""
    found, state, squeeze = lifted(problem, grasps, config.protocol, weight_config(problem, config), config.lift)
    return _judged(problem, grasps, torch.arange(len(grasps)), state.shift, found, state, squeeze, config)


def _judged(
    problem: GraspProblem, grasps: GraspBatch, rows: Int[Tensor, " k"], moved: Float[Tensor, " n"], better: GraspBatch,
    state: GraspState, squeeze: Squeeze, config: SettleConfig,
) -> Settled:
    """The grasps, of these rows the better ones that hold still, and what closing showed."""
    hand, obj = problem.hand, problem.solid
    depth = torch.maximum(deepest_penetration(hand, obj, better, config.protocol), state.pierced)
    most = problem.constraints.max_force
    against = {JAMMED: is_jammed(hand, obj.mass, squeeze, config.shortest_lever),
               HARSH: squeeze.hardest > (math.inf if most is None else most)}
    holds = (state.shift < config.farthest) & (state.turn < config.largest_turn) & (depth < config.deepest)
    holds &= ~torch.stack([*against.values()]).any(0)
    stable = torch.zeros_like(moved, dtype=torch.bool).index_fill(0, rows[holds], True)
    payload = observed(better.payload, state.gave, config.weight.pull * obj.mass, config.protocol)
    better = better.replace(squeeze_torque=squeeze.torque, squeeze_force=squeeze.force, payload=payload)
    known = Evidence.none(len(grasps), obj.mass).known(rows, depth, effort_share(hand, squeeze.torque), state)
    whole = {why: torch.zeros_like(stable).index_fill(0, rows[own], True) for why, own in against.items()}
    return Settled(replaced(grasps, stable, better[holds]), stable, replace(known, moved=moved, stable=stable), whole)


def weigh_settled_all(
    problems: Sequence[GraspProblem], batches: Sequence[GraspBatch], config: WeighingConfig, settling: SettleConfig
) -> list[Float[Tensor, " n"]]:
    """Payloads of settled grasps, weighed in simulation [kg]; several objects together where that is quicker.

    What held the object's mass as it settled carries that at least, and what gave way carries less.
    """
    found: dict[int, Float[Tensor, " n"]] = {}
    for asked, numbers in _alike(problems, settling):
        some = weigh_many(
            problems[0].hand, [problems[i].solid for i in numbers], [batches[i] for i in numbers], settling.protocol,
            weight=asked, config=config, device=str(problems[0].device))
        found |= {i: _as_observed(own, batches[i].payload, asked.pull * problems[i].solid.mass)
                  for i, own in zip(numbers, some, strict=True)}
    return [found[i] for i in range(len(problems))]


def _as_observed(
    weighed: Float[Tensor, " n"], before: Float[Tensor, " n"], pulled: float
) -> Float[Tensor, " n"]:
    """Weighed payloads, no less or no more than a mass that is known to have been held, or not; 0 for none [kg]."""
    if pulled == 0:
        return weighed
    return torch.where(before < pulled, weighed.clamp_max(LESS * pulled), weighed.clamp_min(pulled))


def is_jammed(hand: Hand, mass: float, squeeze: Squeeze, shortest_lever: float) -> Bool[Tensor, " n"]:
    """Whether the object is pressed harder than the joints do with this lever [m], and than some of its weights [kg] would."""
    made = (squeeze.torque * hand.movable * hand.tree.joint_unit).abs().sum(1) / shortest_lever
    return squeeze.force > made + WEIGHTS * GRAVITY * mass + SLIGHT


def effort_share(hand: Hand, torque: Float[Tensor, "n n_dof"]) -> Float[Tensor, " n"]:
    """Largest share of its effort with which a joint squeezes [Nm or N]."""
    return (torque * hand.movable).abs().div(find_efforts(hand).limit).amax(1)


def replaced(grasps: GraspBatch, rows: Bool[Tensor, " n"], others: GraspBatch) -> GraspBatch:
    """The batch with other poses, joints, targets and forces in these rows."""
    values = {}
    for name in ("T_object_wrist", "joints", *PER_JOINT, *CARRYING):
        values[name] = getattr(grasps, name).clone()
        values[name][rows] = getattr(others, name)
    return grasps.poses_only().replace(**values)
