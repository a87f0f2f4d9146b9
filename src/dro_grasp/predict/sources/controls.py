"""Controls: sources that ignore the object's shape, or hardly look at it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.geometry.se3 import apply, apply_to_cloud, compose, random_rotations
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import checked
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.choice import ChoiceConfig, choice_scores
from dro_grasp.predict.sources.source import Progress, Source

CHOICE_POINTS = 160  # Hand points by which a rotation of the mean grasp is chosen; as many as the shipped weights see (ours)


@dataclass(frozen=True)
class MeanGrasp:
    """The mean over training grasps of a hand, in the wrist frame."""

    joints: Float[Tensor, " n_dof"]  # [rad or m]
    object_centre: Float[Tensor, "3"]  # position of the object's centre in the wrist frame [m]


class StartSource(Source):
    """Half-closed hands that face the object, never optimised."""

    name = "start"

    def propose(self, problem: GraspProblem, num: int, seed: int, progress: Progress | None = None) -> GraspBatch:
        """See `palm_facing_starts`."""
        return palm_facing_starts(problem.hand, problem.obj, num, seed)


class MeanGraspSource(Source):
    """The mean of a hand's training grasps at random rotations, or at rotations chosen by geometry as z is."""

    def __init__(self, means: Mapping[str, MeanGrasp], chosen: bool = False) -> None:
        """Keep the means.

        Args:
            means: The mean grasp of each hand, by the hand's name.
            chosen: Whether rotations are chosen.
        """
        self.means, self.config = means, ChoiceConfig() if chosen else ChoiceConfig.first()
        self.name = "mean-grasp-chosen" if chosen else "mean-grasp"

    def knows(self, hand: Hand) -> bool:
        """Hands with training grasps."""
        return hand.name in self.means

    def propose(self, problem: GraspProblem, num: int, seed: int, progress: Progress | None = None) -> GraspBatch:
        """See `mean_grasps`."""
        return mean_grasps(problem, self.means[problem.hand.name], num, seed, self.config)


def mean_grasps(
    problem: GraspProblem, mean: MeanGrasp, num: int, seed: int, config: ChoiceConfig
) -> GraspBatch:
    """The mean grasp at random wrist rotations about the object's centre, each chosen from as many as a prediction is.

    With one draw, nothing looks at the object's shape.
    """
    draws = config.placements * config.draws
    hand, obj = problem.hand, problem.obj
    generator = torch.Generator().manual_seed(seed)
    rotation = random_rotations(num * draws, generator)
    centre = torch.from_numpy(obj.cloud).mean(0)
    T = compose(rotation, centre - rotation @ mean.object_centre)
    thin = problem.thinned(min(CHOICE_POINTS, hand.n_points))
    points = apply_to_cloud(T.to(problem.device), thin.points(mean.joints.to(problem.device)).expand(len(T), -1, -1))
    best = choice_scores(thin, problem.field, points, config.penalties).unflatten(0, (num, draws)).argmax(-1).cpu()
    T = T.unflatten(0, (num, draws))[torch.arange(num), best]
    joints = mean.joints.expand(num, -1).contiguous()
    return GraspBatch.create(hand, obj, T, joints, seed=seed, provenance="control: mean grasp")


@checked
def palm_facing_starts(hand: Hand, obj: ObjectModel, num: int, seed: int) -> GraspBatch:
    """Half-closed hands that face the object, with the palm at its surface; never optimised.

    The palm's axis goes through the object's centre; the palm's centre is at the object's extent along that axis, or up
    to a centimetre before it.
    """
    generator = torch.Generator().manual_seed(seed)
    rotation = random_rotations(num, generator)
    cloud = torch.from_numpy(obj.cloud)
    centre = cloud.mean(0)
    direction = rotation @ hand.palm_direction_wrist
    palm_centre = apply(hand.T_wrist_palm_rest, hand.palm_centre)
    reach = -((cloud - centre) @ direction.mT).amin(0)
    gap = 0.01 * torch.rand(num, generator=generator)
    surface = centre - (reach + gap)[:, None] * direction
    T = compose(rotation, surface - rotation @ palm_centre)
    joints = hand.canonical_joints(0.5).expand(num, -1).contiguous()
    return GraspBatch.create(hand, obj, T, joints, seed=seed, provenance="control: palm-facing start")
