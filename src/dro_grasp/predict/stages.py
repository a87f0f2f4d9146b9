"""The single steps of finishing, and the trial: each takes a problem and grasps, and returns new ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.devices import on_accelerator, one_thread
from dro_grasp.grasps import controller
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.kinds import checked
from dro_grasp.optimize.fingers import EasingConfig, closed_fingers, ease_fingers
from dro_grasp.optimize.grasp_energy import EnergyConfig, GraspEnergy
from dro_grasp.optimize.refinement import RefineConfig, descended
from dro_grasp.optimize.squeeze import closing_targets
from dro_grasp.predict.admission import AdmissionConfig, feasible, opened_wide
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.score.score import ScoreConfig, score_grasps
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, Protocol
from dro_grasp.simulation.trial import simulate

Columns = tuple[Float[Tensor, "n ..."], ...]  # Values of n grasps
Work = Callable[[GraspEnergy, Float[Tensor, "n 4 4"], Float[Tensor, "n n_dof"], float], Columns]  # See `_together`


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
    return refine_all([problem], [grasps], config)[0]


def refine_all(
    problems: Sequence[GraspProblem], batches: Sequence[GraspBatch], config: RefineConfig | None = None
) -> list[GraspBatch]:
    """The same for several objects, together where that is quicker."""
    config = config or RefineConfig()

    def work(energy: GraspEnergy, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], most: float) -> Columns:
        near = replace(config, largest_turn=min(config.largest_turn, most))
        with one_thread(energy.device):
            q = closed_fingers(energy, T, q, config.closing)
        T, q = descended(energy, T, q, near)
        with one_thread(energy.device):
            return T, q, *closing_targets(energy, T, q, config.grip)

    made = _together(work, problems, batches, config.energy, config.batch_size)
    return [grasps if own is None else opened_wide(problem, grasps.with_poses(own[0], own[1]).replace(
        pregrasp_joints=own[2], squeeze_joints=own[3])) for problem, grasps, own in zip(problems, batches, made, strict=True)]


def grip_all(problems: Sequence[GraspProblem], batches: Sequence[GraspBatch], config: RefineConfig) -> list[GraspBatch]:
    """The same grasps with a pregrasp as the problem asks, and a squeeze that balances the contacts' forces."""
    def work(energy: GraspEnergy, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], most: float) -> Columns:
        return closing_targets(energy, T, q, config.grip)

    made = _together(work, problems, batches, config.energy, config.batch_size)
    return [grasps if own is None else opened_wide(problem, grasps.replace(pregrasp_joints=own[0], squeeze_joints=own[1]))
            for problem, grasps, own in zip(problems, batches, made, strict=True)]


@torch.no_grad()
def _together(
    work: Work, problems: Sequence[GraspProblem],
    batches: Sequence[GraspBatch], config: EnergyConfig, given: int | None,
) -> list[Columns | None]:
    """What is made of each batch, on the CPU, by work on poses and joints on the device; None for no grasps.

    Rows of several objects are computed as one on a device, and wherever a batch size is `given`. The last argument of the work
    is the largest tilt [rad].
    """
    found: list[Columns | None] = [None] * len(problems)
    for problem, grasps in zip(problems, batches, strict=True):
        grasps.require_hand(problem.hand)
    for rows in grouped(problems, [len(grasps) for grasps in batches], given):
        counts = [len(batches[i]) for i in rows]
        energy = GraspEnergy.joined([problems[i].energy(config) for i in rows], counts)
        T, q = (torch.cat([getattr(batches[i], name) for i in rows]).to(energy.device) for name in ("T_object_wrist", "joints"))
        most = problems[rows[0]].constraints.max_tilt
        made = [part.cpu().split(counts) for part in work(energy, T, q, math.inf if most is None else most)]
        for i, *own in zip(rows, *made, strict=True):
            found[i] = tuple(own)
    return found


def grouped(problems: Sequence[GraspProblem], counts: Sequence[int], given: int | None = None) -> list[list[int]]:
    """Which problems are computed as one, without those of which there is nothing to compute.

    On a CPU, whose cache is small, each is alone, unless a batch size is given; so are those with surroundings or a region.
    """
    together: dict[object, list[int]] = {}
    for i, problem in enumerate(problems):
        if counts[i]:
            own = problem.constraints.max_tilt if problem.joins and (given or on_accelerator(problem.device)) else (i, "alone")
            together.setdefault(own, []).append(i)
    return list(together.values())


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
    return score_all([problem], [grasps], config)[0]


def score_all(
    problems: Sequence[GraspProblem], batches: Sequence[GraspBatch], config: ScoreConfig | None = None
) -> list[GraspBatch]:
    """The same for several objects, together where that is quicker."""
    config, found = config or ScoreConfig(), list(batches)
    for problem, grasps in zip(problems, batches, strict=True):
        grasps.require_hand(problem.hand)
    for rows in grouped(problems, [len(grasps) or 1 for grasps in batches], config.batch_size):
        counts = [len(batches[i]) for i in rows]
        energy = GraspEnergy.joined([problems[i].energy(config.energy) for i in rows], counts)
        whole = batches[rows[0]] if len(rows) == 1 else GraspBatch.concatenate([batches[i] for i in rows])
        for i, score in zip(rows, score_grasps(energy, whole, config).split(counts), strict=True):
            found[i] = batches[i].replace(score=score)
    return found


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
