"""What the package computes of several objects at once, asked of one."""

from __future__ import annotations

from typing import Any

from jaxtyping import Float
from torch import Tensor

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.settling import SettleConfig, Settled, SettledBest, settle_all, settle_best_all
from dro_grasp.simulation.trial import settle_many
from dro_grasp.simulation.weighing import weigh_many
from dro_grasp.training.data.engine.shards import Yield
from dro_grasp.training.data.engine.worker import EngineConfig, Wanted, valid_grasps_of_all


def settle_grasps(problem: GraspProblem, grasps: GraspBatch, config: SettleConfig | None = None) -> Settled:
    """Settle the grasps of an object."""
    return settle_all([problem], [grasps], config)[0]


def settle_best(problem: GraspProblem, grasps: GraspBatch, least: int, config: SettleConfig | None = None) -> SettledBest:
    """Settle the better share of them."""
    return settle_best_all([problem], [grasps], least, config)[0]


def settle(hand: Hand, obj: ObjectModel, grasps: GraspBatch, *protocol: Any, **options: Any) -> GraspBatch:
    """Label them where closing leaves them."""
    return settle_many(hand, [obj], [grasps], *protocol, **options)[0]


def weigh(hand: Hand, obj: ObjectModel, grasps: GraspBatch, *protocol: Any, **options: Any) -> Float[Tensor, " n"]:
    """Weigh what they carry."""
    return weigh_many(hand, [obj], [grasps], *protocol, **options)[0]


def valid_grasps(hand: Hand, obj: ObjectModel, seed: int, config: EngineConfig) -> tuple[GraspBatch, Yield]:
    """Make labels of the object."""
    return valid_grasps_of_all(hand, [Wanted(obj, seed, config.candidates)], config)[0]
