"""Sources that descend the grasp energy: the optimiser, which chooses among descents, and DFC, which does not."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.kinds import Checked
from dro_grasp.optimize.contacts import ContactConfig
from dro_grasp.optimize.starts import StartConfig
from dro_grasp.optimize.synthesis import SynthesisConfig, synthesize_with
from dro_grasp.predict.admission import facing
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.source import POINTS, Candidates, Progress, Source

DESCENT_STEPS = 1200  # Steps of a descent that is not settled: ten times those of the data engine (ours)


@dataclass(frozen=True)
class OptimiserConfig(Checked):
    """How the optimiser proposes (ours)."""

    starts_per_candidate: int = 4
    """Grasps that are optimised for each candidate; those of lowest energy are proposed."""
    synthesis: SynthesisConfig = field(default_factory=SynthesisConfig)
    """The descent. The problem's constraints say where it starts."""
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
        wanted, config = problem.constraints, self.config
        starts = replace(config.synthesis.starts, direction=wanted.direction, max_tilt=wanted.max_tilt,
                         contact_region=wanted.contact_region)
        synthesis = replace(config.synthesis, starts=starts)
        count = config.starts_per_candidate * num
        grasps = synthesize_with(problem.energy(synthesis.energy), problem.obj, count, seed, synthesis, progress)
        kept = facing(problem, grasps, config.farthest_direction)
        found = Candidates.of(problem, grasps[kept][:num].poses_only(), self.n_points)
        return replace(found, turned=min(int((~kept).sum()), num - len(found)))


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
