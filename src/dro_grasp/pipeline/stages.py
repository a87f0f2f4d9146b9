"""The stages after the proposal: refine, rank, evaluate. Each takes a problem and grasps, and returns new grasps."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool
from torch import Tensor

from dro_grasp.devices import one_thread
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import completed
from dro_grasp.optimization.finger_closing import close_idle_fingers
from dro_grasp.optimization.grip import gripping
from dro_grasp.optimization.refinement import RefineConfig, refine_grasps
from dro_grasp.optimization.starts import StartConfig, angle_to_arc
from dro_grasp.optimization.synthesis import SynthesisConfig, synthesize_with
from dro_grasp.pipeline.problem import GraspProblem
from dro_grasp.ranking.score import ScoreConfig, score_grasps
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, Protocol
from dro_grasp.simulation.trial import simulate

FARTHEST_DIRECTION = math.radians(20.0)
"""Largest angle between the palm direction of an optimised grasp and the direction that was asked for [rad] (ours)."""


STARTS_PER_CANDIDATE = 4
"""Grasps that are optimised for each candidate; those of lowest energy are kept (ours)."""
LEAST_CLEARANCE = 0.002
"""Least distance of a hand's surface points to its surroundings [m] (ours); its corners come up to 2 mm nearer."""


def complete(problem: GraspProblem, grasps: GraspBatch) -> GraspBatch:
    """Grasps that all state a pregrasp and a squeeze; the controller makes the missing ones.

    Args:
        problem: Hand and object.
        grasps: Any grasps of the two; what they state stays.

    Raises:
        GraspFileError: The grasps are of another hand.
    """
    grasps.require_hand(problem.hand)
    return completed(problem.hand, grasps, problem.centre)


def refine(problem: GraspProblem, grasps: GraspBatch, config: RefineConfig | None = None) -> GraspBatch:
    """Grasps near the given ones: idle fingers close, the grasp energy descends, and the squeeze balances the contacts' forces.

    Args:
        problem: Hand and object.
        grasps: Any grasps of the two; outcomes, scores, energies and what they state of pregrasp and squeeze are dropped.
        config: Steps, bounds and forces.
    """
    config = config or RefineConfig()
    grasps.require_hand(problem.hand)
    energy = problem.energy(config.energy)
    with one_thread():
        closed = close_idle_fingers(energy, grasps, config.closing)
    refined = refine_grasps(energy, closed, config)
    with one_thread():
        return gripping(energy, refined, config.grip)


def rank(problem: GraspProblem, grasps: GraspBatch, config: ScoreConfig | None = None) -> GraspBatch:
    """Grasps with their score, the best first.

    Args:
        problem: Hand and object.
        grasps: Any grasps of the two.
        config: What the score is.
    """
    return scored(problem, grasps, config).sorted_by_score()


def scored(problem: GraspProblem, grasps: GraspBatch, config: ScoreConfig | None = None) -> GraspBatch:
    """Grasps with their score, in the same order."""
    config = config or ScoreConfig()
    grasps.require_hand(problem.hand)
    return grasps.replace(score=score_grasps(problem.energy(config.energy), grasps, config))


def evaluate(
    problem: GraspProblem, grasps: GraspBatch, protocol: str | Protocol = DEFAULT_PROTOCOL,
    progress: Callable[[int, int], None] | None = None, workers: int | None = None,
) -> GraspBatch:
    """Grasps with the outcome of a trial each.

    Args:
        problem: Hand and object; a bare cloud cannot be simulated.
        grasps: Grasps of the two.
        protocol: Name of a protocol, or one of your own.
        progress: Called with (trials done, trials in all).
        workers: Threads; all cores by default.

    Raises:
        ObjectError: The object is a bare cloud.
        OptionError: No protocol has the name.
    """
    return grasps.with_trial(simulate(problem.hand, problem.obj, grasps, protocol, workers=workers, progress=progress))


def optimise(
    problem: GraspProblem, num: int, seed: int,
    progress: Callable[[int, int], None] | None = None,
) -> GraspBatch:
    """Candidates from synthesis; no network is asked, so any hand and object will do.

    Args:
        problem: Hand and object.
        num: How many, at most: those are left out that turn away from the direction.
        seed: The same seed gives the same candidates.
        progress: Called with (grasps optimised, grasps to optimise).
    """
    config = SynthesisConfig(starts=StartConfig(direction=problem.constraints.direction))
    energy = problem.energy(config.energy)
    grasps = synthesize_with(energy, problem.obj, STARTS_PER_CANDIDATE * num, seed, config, progress)
    return grasps[facing(problem, grasps)][:num].bare()


def facing(problem: GraspProblem, grasps: GraspBatch) -> Bool[Tensor, " n"]:
    """Which grasps have palms near the wanted direction; over a plane, those too that tilt from there towards it."""
    direction, surroundings = problem.constraints.direction, problem.surroundings
    if direction is None:
        return torch.ones(len(grasps), dtype=torch.bool)
    palm = problem.hand.palm_directions(grasps.T_object_wrist)
    wanted = torch.nn.functional.normalize(torch.tensor(direction), dim=0)
    up = None if surroundings is None else surroundings.up
    return angle_to_arc(palm, wanted, up) < FARTHEST_DIRECTION


def permitted(problem: GraspProblem, grasps: GraspBatch) -> Bool[Tensor, " n"]:
    """Which complete grasps respect the problem's constraints."""
    return clear(problem, grasps)


def clear(problem: GraspProblem, grasps: GraspBatch) -> Bool[Tensor, " n"]:
    """Which complete grasps keep the hand out of its surroundings, in pregrasp, grasp and squeeze."""
    near = problem.clearance
    if near is None or not len(grasps):
        return torch.ones(len(grasps), dtype=torch.bool)
    T = grasps.T_object_wrist.to(problem.device)
    postures = (grasps.pregrasp_joints, grasps.joints, grasps.squeeze_joints)
    return torch.stack([near.distance(T, q.to(problem.device)) for q in postures]).amin(0).cpu() > LEAST_CLEARANCE
