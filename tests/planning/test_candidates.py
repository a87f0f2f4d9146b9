"""Grasps to plan for: where the network knows none, the optimiser makes rivals."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from dro_grasp.objects.catalogue import load_object
from dro_grasp.planning import candidates
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.stages import Optimised
from tests.helpers.loaded_hands import loaded_hand


@pytest.mark.parametrize(("known", "lacking"), [(-math.inf, 0), (math.inf, 2)])
def test_the_optimiser_is_asked_for_what_the_network_lacks(known: float, lacking: int, monkeypatch: pytest.MonkeyPatch) -> None:
    asked, optimise = [], candidates.optimise

    def counted(problem: GraspProblem, num: int, seed: int) -> Optimised:
        asked.append(num)
        return optimise(problem, num, seed)

    monkeypatch.setattr(candidates, "optimise", counted)
    monkeypatch.setattr(candidates, "KNOWN", known)
    can, T = load_object("can"), np.eye(4)
    T[:3, 3] = 0.4, 0.1, 0.2
    found = candidates.grasps_in_world(GraspPredictor(), loaded_hand("gripper3"), can, T, 6, Constraints(), torch.eye(3)[:2])
    assert asked == [candidates.OPTIMISED_IN_SURROUNDINGS] * lacking
    assert len(found) == 6
    assert (found.score.diff() <= 0).all()
    palms = loaded_hand("gripper3").palm_directions(found.T_object_wrist)
    assert (palms[:, :2].amax(1) > 0.8).all()
    assert (found.T_object_wrist[:, :3, 3] - torch.tensor(T[:3, 3])).norm(dim=1).max() < 0.3
