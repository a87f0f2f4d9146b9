"""Pinches with several squeezes: of a block between two jaws, trials say which hold it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from dro_grasp.geometry.se3 import compose
from dro_grasp.hands.hand import Hand
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.lifting import LiftConfig, gives, lifted
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.simulation.grasp_state import WeightConfig
from dro_grasp.simulation.trial import simulate
from tests.simulation.test_table import block, jaws, pinch

__all__ = ["jaws"]
WIDTH = 0.02


def problem_of(hand: Hand) -> GraspProblem:
    """A block on a table that the jaws may touch."""
    return GraspProblem(hand, block((WIDTH, 0.05, 0.02)), constraints=Constraints((0.0, 0.0, -1.0), table=0.0))


def test_the_squeeze_that_holds_is_taken(jaws: Hand) -> None:
    """Two jaws hold by friction 0.5 as much as one presses: at a tenth of that it slips, at three times it stays."""
    problem = problem_of(jaws)
    grasp = problem.on_table(pinch(jaws, problem.obj, 0.001, WIDTH))
    needed = problem.mass * 9.81 / (3.0 / 0.03**2)  # deflection of a servo of that stiffness [m]
    soft = grasp.replace(squeeze_joints=grasp.joints + 0.1 * needed)
    config, weight = LiftConfig(strengths=(1.0, 30.0)), WeightConfig(pulling=1.0)
    assert not bool(simulate(jaws, problem.obj, soft, "carry").success[0])
    found, state, squeeze = lifted(problem, soft, "carry", weight, config)
    assert torch.allclose(found.squeeze_joints - found.joints, 30 * (soft.squeeze_joints - soft.joints), atol=1e-6)
    assert bool(simulate(jaws, problem.obj, problem.on_table(found), "carry").success[0])
    assert float(gives(state, "carry")[0]) < 1
    assert float(squeeze.force[0]) > 0


def test_rows_stay_in_order_and_what_holds_nothing_has_no_payload(jaws: Hand) -> None:
    problem = problem_of(jaws)
    good = pinch(jaws, problem.obj, 0.001, WIDTH)
    away = good.replace(T_object_wrist=compose(torch.eye(3), torch.tensor([[0.0, 0.0, 0.2]])))
    mixed = problem.on_table(type(good).concatenate([away, good, away]))
    found, state, _ = lifted(problem, mixed, "carry", WeightConfig(pulling=0.5), LiftConfig())
    assert torch.equal(found.T_object_wrist, mixed.T_object_wrist)
    assert (gives(state, "carry") < 1).tolist() == [False, True, False]
    assert found.payload[[0, 2]].tolist() == [0.0, 0.0]
    assert float(found.payload[1]) > problem.mass


@pytest.mark.parametrize("margin", [3.0, 0.75])
def test_a_larger_margin_presses_harder(jaws: Hand, margin: float) -> None:
    problem = problem_of(jaws)
    grasp = problem.on_table(pinch(jaws, problem.obj, 0.001, WIDTH))
    config = LiftConfig(strengths=(0.5,))
    found, _, _ = lifted(problem, grasp, "carry", replace(WeightConfig(), margin=margin), config)
    ratio = (found.squeeze_joints - found.joints) / (grasp.squeeze_joints - grasp.joints)
    assert torch.allclose(ratio, torch.full_like(ratio, 0.5 * margin / 1.5), atol=1e-4)
