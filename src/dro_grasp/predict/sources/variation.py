"""Variations as a source: grasps near the best that are known so far, moved a little at random.

Where one candidate of hundreds holds, as on heavy or awkward objects, its neighbourhood holds many; settling chooses among
them, as an evolution strategy does. Ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.geometry.se3 import turned_about
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.kinds import Checked
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.source import Progress, Source


@dataclass(frozen=True)
class VariationConfig(Checked):
    """Which grasps are varied, and how far (ours)."""

    parents: int = 16
    """Grasps that are varied, those of the best score."""
    alike: float = 1.5
    """Parents that score more are varied equally often [log-odds of holding]."""
    sharpness: float = 0.5
    """Logarithm of how much oftener a parent is varied for each unit of score below that."""
    shift: float = 0.01
    """Standard deviation of the grasp centre along each axis, of the widest variations [m]."""
    turn: float = math.radians(10.0)
    """Standard deviation of the hand's rotation about each axis [rad]."""
    bend: float = 0.12
    """Standard deviation of each joint [rad; for sliding joints in their tree's unit]."""
    narrowest: float = 0.2
    """The narrowest variations, as a share of the widest; each has its own share, drawn evenly."""


class VariationSource(Source):
    """Known grasps of the problem, varied. Later calls know more, so it is made anew for each."""

    name = "variation"

    def __init__(self, known: GraspBatch, config: VariationConfig | None = None) -> None:
        """Keep what is varied.

        Args:
            known: Grasps with scores, of the hand and object that are proposed for; at least one.
            config: Which of them, and how far.
        """
        self.config = config or VariationConfig()
        self.parents = known[known.score.topk(min(self.config.parents, len(known))).indices]

    def propose(self, problem: GraspProblem, num: int, seed: int, progress: Progress | None = None) -> GraspBatch:
        """Variations of parents that are drawn by their score."""
        config, hand, generator = self.config, problem.hand.to("cpu"), torch.Generator().manual_seed(seed)
        weight = (config.sharpness * self.parents.score.clamp_max(config.alike)).softmax(0)
        chosen = self.parents[torch.multinomial(weight, num, replacement=True, generator=generator)]
        share = config.narrowest + (1 - config.narrowest) * torch.rand(num, 1, generator=generator)

        def noise(size: int) -> Float[Tensor, "n size"]:
            return share * torch.randn(num, size, generator=generator)

        T, q = chosen.T_object_wrist, chosen.joints
        T = turned_about(T, hand.grasp_centres(T), config.shift * noise(3), config.turn * noise(3))
        bent = (q + config.bend * hand.tree.joint_unit * noise(hand.tree.n_dof)).clamp(hand.lower, hand.upper)
        return chosen.with_poses(T, torch.where(hand.movable, bent, q))
