"""The single steps of finishing, and the trial: each takes a problem and grasps, and returns new ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch

from dro_grasp.devices import one_thread
from dro_grasp.grasps import controller
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.kinds import checked
from dro_grasp.optimize.fingers import EasingConfig, close_idle_fingers, ease_fingers
from dro_grasp.optimize.grasp_energy import EnergyConfig
from dro_grasp.optimize.refinement import RefineConfig, refine_grasps
from dro_grasp.optimize.squeeze import gripping
from dro_grasp.predict.admission import AdmissionConfig, feasible, opened_wide
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.score.score import ScoreConfig, score_grasps
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, Protocol
from dro_grasp.simulation.trial import simulate


def complete(problem: GraspProblem, grasps: GraspBatch) -> GraspBatch:
    """Grasps that all state a pregrasp and a squeeze; the controller makes the missing ones, and opens as the problem asks.

    Args:
        problem: Hand and object.
        grasps: Any grasps of the two; what they state stays.

    Raises:
        GraspFileError: The grasps are of another hand.
    """
    grasps.require_hand(problem.hand)
    return opened_wide(problem, controller.complete(problem.hand, grasps, problem.centre))


def refine(problem: GraspProblem, grasps: GraspBatch, config: RefineConfig | None = None) -> GraspBatch:
    """Grasps near the given ones: idle fingers close, the grasp energy descends, and the squeeze balances the contacts' forces.

    Args:
        problem: Hand and object.
        grasps: Any grasps of the two; outcomes, scores, energies and what they state of pregrasp and squeeze are dropped.
        config: Steps, bounds and forces.

    Raises:
        GraspFileError: The grasps are of another hand.
    """
    config, max_tilt = config or RefineConfig(), problem.constraints.max_tilt
    grasps.require_hand(problem.hand)
    energy = problem.energy(config.energy)
    if max_tilt is not None:
        config = replace(config, largest_turn=min(config.largest_turn, max_tilt))
    with one_thread():
        closed = close_idle_fingers(energy, grasps, config.closing)
    refined = refine_grasps(energy, closed, config)
    with one_thread():
        return grip(problem, refined, config)


def grip(problem: GraspProblem, grasps: GraspBatch, config: RefineConfig) -> GraspBatch:
    """The same grasps with a pregrasp as the problem asks, and a squeeze that balances the contacts' forces."""
    return opened_wide(problem, gripping(problem.energy(config.energy), grasps, config.grip))


def ease(
    problem: GraspProblem, grasps: GraspBatch, config: EasingConfig | None = None, admission: AdmissionConfig | None = None
) -> GraspBatch:
    """Complete grasps as they are given away: on a bare cloud, fingers open until they are clear of it; those on a mesh stay.

    It comes last. Score and energy judge grasps whose fingers touch, and are kept. Where the constraints forbid that, as a
    table does, fingers open as on a surface that was seen, or not at all.
    """
    if not problem.obj.is_cloud or not len(grasps):
        return grasps
    energy, seen = problem.energy(EnergyConfig()), problem.obj.seen
    joints, rows = grasps.joints.clone(), torch.arange(len(grasps))
    for known in (None,) if seen is None else (seen, None):
        with one_thread():
            apart = ease_fingers(energy, grasps[rows], known, config)
        allowed = feasible(problem, apart, admission)
        joints[rows[allowed]] = apart.joints[allowed]
        rows = rows[~allowed]
    return grasps.replace(joints=joints)


def rank(problem: GraspProblem, grasps: GraspBatch, config: ScoreConfig | None = None) -> GraspBatch:
    """Grasps with their score, the best first.

    Args:
        problem: Hand and object.
        grasps: Any grasps of the two.
        config: What the score is.

    Raises:
        GraspFileError: The grasps are of another hand.
    """
    return scored(problem, grasps, config).sorted_by_score()


def scored(problem: GraspProblem, grasps: GraspBatch, config: ScoreConfig | None = None) -> GraspBatch:
    """Grasps with their score, in the same order."""
    config = config or ScoreConfig()
    grasps.require_hand(problem.hand)
    return grasps.replace(score=score_grasps(problem.energy(config.energy), grasps, config))


@checked
def evaluate(
    problem: GraspProblem, grasps: GraspBatch, protocol: str | Protocol = DEFAULT_PROTOCOL,
    progress: Callable[[int, int], None] | None = None, workers: int | None = None, another: bool = False,
) -> GraspBatch:
    """Grasps with the outcome of a trial each.

    Args:
        problem: Hand and object; a bare cloud cannot be simulated.
        grasps: Grasps of the two.
        protocol: Name of a protocol, or one of your own.
        progress: Called with (trials done, trials in all).
        workers: Threads; all cores by default.
        another: Take the problem's object although the grasps were made for one of other name and content.

    Raises:
        ObjectError: The object is a bare cloud, or not that of the grasps.
        GraspFileError: The grasps are of another hand.
        OptionError: No protocol has the name.
    """
    result = simulate(
        problem.hand, problem.obj, grasps, protocol, workers=workers, progress=progress, another=another)
    return grasps.with_trial(result)
