"""Sources that descend the grasp energy: the optimiser, which chooses among descents, and DFC, which does not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch

from dro_grasp._version import __version__
from dro_grasp.devices import on_accelerator
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.kinds import Checked
from dro_grasp.optimize.contacts import ContactConfig
from dro_grasp.optimize.pinches import PinchConfig, PinchSearch, opposed_pairs
from dro_grasp.optimize.starts import StartConfig
from dro_grasp.optimize.synthesis import Lot, SynthesisConfig, synthesize_all, synthesize_with
from dro_grasp.predict.admission import facing
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.source import POINTS, Asked, Candidates, Progress, Source

PINCHES = f"dro-grasp {__version__}, pinches 1"
"""Provenance of pinches; the number counts up when the method changes."""
DESCENT_STEPS = 1200  # Steps of a descent that is not settled: ten times those of the data engine (ours)


@dataclass(frozen=True)
class OptimiserConfig(Checked):
    """How the optimiser proposes (ours)."""

    starts_per_candidate: int = 4
    """Grasps that are optimised for each candidate; those of lowest energy are proposed."""
    synthesis: SynthesisConfig = field(default_factory=SynthesisConfig)
    """The descent. The problem's constraints say where it starts."""
    pinch: PinchConfig = field(default_factory=PinchConfig)
    """How pinches are sought, which are proposed instead where the object lies flat on a table."""
    farthest_direction: float = math.radians(20.0)
    """Largest angle between the palm direction of a candidate and the direction that was asked for [rad]."""


class OptimiserSource(Source):
    """Grasps of any hand on any object from geometry alone, as the data engine makes them: nothing is learned."""

    name = "optimiser"

    def __init__(self, config: OptimiserConfig | None = None, n_points: int = POINTS) -> None:
        """Keep the configuration.

        Args:
            config: Descent and choice.
            n_points: Hand points beside each candidate.
        """
        self.config, self.n_points = config or OptimiserConfig(), n_points

    def propose(self, problem: GraspProblem, num: int, seed: int, progress: Progress | None = None) -> Candidates:
        """Of several descents for each candidate, those of lowest energy."""
        return self.propose_all([Asked(problem, num, seed)], progress)[0]

    def propose_all(self, asked: Sequence[Asked], progress: Progress | None = None) -> list[Candidates]:
        """The same for several objects, whose hands descend together."""
        config, found = self.config, [self._pinched(*each) for each in asked]
        lots = [Lot(each.problem.energy(config.synthesis.energy), each.problem.obj, config.starts_per_candidate * each.num,
                    each.seed, self._synthesis(each.problem)) for each, pinched in zip(asked, found, strict=True)
                if pinched is None]
        made = iter(synthesize_all(lots, progress) if lots else [])
        return [self._best(each.problem, next(made), each.num) if pinched is None else pinched
                for each, pinched in zip(asked, found, strict=True)]

    def _pinched(self, problem: GraspProblem, num: int, seed: int) -> Candidates | None:
        """Pinches of what lies flat on a table; None for other things, and where there are none."""
        if problem.lies_flat and len(found := pinch(problem, num, seed, self.config)):
            return replace(Candidates.of(problem, found, self.n_points), exact=True)
        return None

    def _synthesis(self, problem: GraspProblem) -> SynthesisConfig:
        """The descent, which starts as the constraints say."""
        wanted, synthesis = problem.constraints, self.config.synthesis
        return replace(synthesis, starts=replace(
            synthesis.starts, direction=wanted.direction, max_tilt=wanted.max_tilt, contact_region=wanted.contact_region))

    def _best(self, problem: GraspProblem, grasps: GraspBatch, num: int) -> Candidates:
        """Those of lowest energy that face the object as they should."""
        kept = facing(problem, grasps, self.config.farthest_direction)
        found = Candidates.of(problem, grasps[kept][:num].poses_only(), self.n_points)
        return replace(found, turned=min(int((~kept).sum()), num - len(found)))


def pinch(problem: GraspProblem, num: int, seed: int, config: OptimiserConfig) -> GraspBatch:
    """The best of several pinches for each that is wanted; none where no two sides of the object are opposed."""
    if on_accelerator(problem.device):  # a search at random, with generators of the processor
        problem = GraspProblem(problem.hand, problem.obj, "cpu", problem.constraints)
    generator, wanted, table = torch.Generator().manual_seed(seed), problem.constraints, problem.table
    assert table is not None
    energy = problem.energy(config.synthesis.energy)
    search = PinchSearch(energy, problem.mass, wanted.direction, wanted.max_tilt, config.pinch)
    pairs = opposed_pairs(problem.obj, table, search.widest(generator), config.pinch.pairs * num, config.pinch,
                          generator)
    if pairs is None:
        return GraspBatch.none(problem.hand, problem.obj)
    found = search.search(pairs, generator)
    best = found.rows(found.cost.argsort(stable=True)[:num])
    return GraspBatch.create(problem.hand, problem.obj, best.T, best.joints, pregrasp_joints=best.pregrasp,
                             squeeze_joints=best.squeeze, seed=seed, provenance=PINCHES)


class DescentSource(Source):
    """DFC (Liu et al. 2021), as in DexGraspNet: one descent a grasp, none of which is left out.

    Differs from DFC: the energies and the scheme are the data engine's. Every finger holds, and descents begin with open
    hands, which no choice among candidates makes up for; both were chosen on built-in training objects.
    """

    name = "dfc"

    def __init__(self, config: SynthesisConfig | None = None) -> None:
        self.config = config or SynthesisConfig(
            steps=DESCENT_STEPS, contacts=ContactConfig(idle=0.0), starts=StartConfig(openness=(0.4, 1.0), joint_noise=0.1))

    def propose(self, problem: GraspProblem, num: int, seed: int, progress: Progress | None = None) -> GraspBatch:
        """All that the descents end at, in no particular order of quality."""
        energy = problem.energy(self.config.energy)
        return synthesize_with(energy, problem.obj, num, seed, self.config, progress).poses_only()
