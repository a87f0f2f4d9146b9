"""Grasps to plan for: where the network knows none, the optimiser makes rivals, in every direction that is asked for."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dro_grasp.arm.planning.candidates import grasps_in_world, paper_directions
from dro_grasp.errors import NoGraspError, OptionError
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimize.synthesis import SynthesisConfig
from dro_grasp.predict.admission import AdmissionConfig
from dro_grasp.predict.config import GraspRequest, PredictorConfig, RescueConfig
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.finish import FinishConfig
from dro_grasp.predict.predictor import GraspPredictor, Prediction
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.optimiser import OptimiserConfig
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.weights import untrained_weights

HAND, CAN = loaded_hand("gripper3"), load_object("can")
T = np.eye(4)
T[:3, 3] = 0.4, 0.1, 0.2


def predictor(folder: Path, trusted: float) -> GraspPredictor:
    config = PredictorConfig(
        optimiser=OptimiserConfig(synthesis=SynthesisConfig(steps=30)), finish=FinishConfig(settle=None),
        rescue=RescueConfig(trusted_scores=(trusted,), per_grasp=2))
    return GraspPredictor(str(untrained_weights(folder)), config=config)


@pytest.mark.parametrize(("trusted", "optimised"), [(-math.inf, False), (math.inf, True)])
def test_the_optimiser_is_asked_for_what_the_network_lacks(trusted: float, optimised: bool, tmp_path: Path) -> None:
    found = grasps_in_world(
        predictor(tmp_path, trusted), HAND, CAN, T, GraspRequest(6, 1, 1), Constraints(), torch.eye(3)[:2])
    assert len(found) == 6
    assert any(not maker.startswith("network") for maker in found.provenance) == optimised
    assert (found.score.diff() <= 0).all()
    assert (found.T_object_wrist[:, :3, 3] - torch.tensor(T[:3, 3])).norm(dim=1).max() < 0.3
    palms = HAND.palm_directions(found.T_object_wrist)
    assert (palms[:, :2].amax(1) > 0.8).all()
    assert (palms.argmax(1) == 0).sum() == (palms.argmax(1) == 1).sum() == 3, "each direction has its share"


def test_a_request_for_fewer_grasps_than_directions_asks_for_some_of_them(tmp_path: Path) -> None:
    asked, request = predictor(tmp_path, math.inf), GraspRequest(1, 1, source="optimiser")
    found = grasps_in_world(asked, HAND, CAN, T, request, Constraints(), torch.eye(3)[1:])
    assert len(found) == 1
    assert float(HAND.palm_directions(found.T_object_wrist)[0, 1]) > 0.8
    few = paper_directions(2)
    torch.testing.assert_close(few, torch.tensor([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), atol=1e-6, rtol=0)


def test_where_nothing_is_found_it_says_why(tmp_path: Path) -> None:
    nowhere = PredictorConfig(
        finish=FinishConfig(settle=None, admission=AdmissionConfig(least_clearance=9.0)), rescue=RescueConfig(
            trusted_in_surroundings=()))
    asked = GraspPredictor(str(untrained_weights(tmp_path)), config=nowhere)
    for directions in ("all", torch.eye(3)[:2]):
        with pytest.raises(NoGraspError, match=r"only 0 of \d+ candidates on object 'can' ") as told:
            grasps_in_world(asked, HAND, CAN, T, GraspRequest(2, 1, 1), Constraints(table=0.0), directions)
        assert "lower table" not in str(told.value), "the table is the robot's"
    with pytest.raises(OptionError, match="leaves nothing of the object"):
        grasps_in_world(asked, HAND, CAN, T, GraspRequest(2, 1, 1), Constraints(table=2.0))


@pytest.mark.parametrize("num", [1, 2])
def test_each_request_has_its_direction(num: int) -> None:
    asked = []

    class Listener(GraspPredictor):
        def run(self, problem: GraspProblem, *arguments: Any) -> Prediction:
            asked.append(problem.constraints.direction)
            raise NoGraspError("nothing is made")

    with pytest.raises(NoGraspError):
        grasps_in_world(Listener(), HAND, CAN, T, GraspRequest(num), Constraints(), "paper")
    assert len(asked) == num
    assert all(direction is not None for direction in asked)
