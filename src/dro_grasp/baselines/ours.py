"""The methods of this package: the network, the optimiser, and DFC, which is the optimiser without any choice."""

from __future__ import annotations

import torch

from dro_grasp.baselines.method import Made, Method, finished
from dro_grasp.energy.contacts import ContactConfig
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.optimization.starts import StartConfig
from dro_grasp.optimization.synthesis import SynthesisConfig, synthesize_with
from dro_grasp.pipeline.problem import GraspProblem
from dro_grasp.pipeline.proposal import propose
from dro_grasp.pipeline.stages import optimise
from dro_grasp.predictor import GraspPredictor, GraspRequest, Method as Source
from dro_grasp.stopwatch import Stopwatch

CANDIDATES = 4
"""Candidates for each grasp that a method returns which ranks them, as `generate` has it (ours)."""
DESCENT_STEPS = 1200
"""Steps of a descent that is not settled: ten times those of the data engine (ours)."""


class DistanceMethod(Method):
    """The D(R,O) network; it returns what `generate` does, with the optimiser's help where the score asks for it."""

    def __init__(
        self, predictor: GraspPredictor, name: str = "dro", candidates: int = CANDIDATES, source: Source = "auto"
    ) -> None:
        self.predictor, self.name, self.candidates = predictor, name, candidates
        self.source: Source = source

    def make(self, problem: GraspProblem, num: int, seed: int) -> GraspBatch:
        """Grasps of the network alone."""
        return self.timed(problem, num, seed)[0]

    @torch.no_grad()
    def timed(self, problem: GraspProblem, num: int, seed: int) -> tuple[GraspBatch, dict[str, float]]:
        """Grasps of the network alone, and the time of network and decoding."""
        generator, watch = torch.Generator().manual_seed(seed), Stopwatch()
        return propose(problem, self.predictor.network, num, generator, self.predictor.config, watch).grasps, watch.seconds

    def best(self, problem: GraspProblem, num: int, seed: int) -> Made:
        """Grasps as `generate` returns them."""
        made = self.predictor.run(problem, GraspRequest(num, seed, candidates=self.candidates, method=self.source))
        return Made(made.grasps, made.candidates)


class SynthesisMethod(Method):
    """Grasps that the optimiser makes without a network; it returns the best by the score that also ranks the network's."""

    name = "synthesise"

    def __init__(self, candidates: int = CANDIDATES) -> None:
        self.candidates = candidates

    def make(self, problem: GraspProblem, num: int, seed: int) -> GraspBatch:
        """The data engine's candidates: of several descents, those of lowest energy."""
        return optimise(problem, num, seed).grasps

    def best(self, problem: GraspProblem, num: int, seed: int) -> Made:
        """The best of refined, settled candidates by score."""
        grasps = finished(problem, self.make(problem, self.candidates * num, seed), num)
        return Made(grasps.sorted_by_score()[:num], self.candidates * num)


class DescentMethod(Method):
    """DFC (Liu et al. 2021), as in DexGraspNet: one descent a grasp, none of which is left out.

    Differs from DFC: the energies and the scheme are the data engine's. Every finger holds, and descents begin with open
    hands, which no choice among candidates makes up for; both were chosen on built-in training objects.
    """

    name = "dfc"

    def __init__(self, config: SynthesisConfig | None = None) -> None:
        self.config = config or SynthesisConfig(
            steps=DESCENT_STEPS, contacts=ContactConfig(idle=0.0), starts=StartConfig(openness=(0.4, 1.0), joint_noise=0.1))

    def make(self, problem: GraspProblem, num: int, seed: int) -> GraspBatch:
        """All that the descents end at, in no particular order of quality."""
        return synthesize_with(problem.energy(self.config.energy), problem.obj, num, seed, self.config).bare()
