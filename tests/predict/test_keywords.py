"""Keywords of `predict`: what they replace of the constraints, and in which form they may be given."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Never

import numpy as np
import pytest
import torch

from dro_grasp.errors import NoGraspError
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Constraints]:
    """Constraints of what is asked for; no grasps are made."""
    asked = []

    def listen(self: GraspPredictor, problem: GraspProblem, *arguments: object) -> Never:
        asked.append(problem.constraints)
        raise NoGraspError("nothing is made")

    monkeypatch.setattr(GraspPredictor, "run", listen)
    return asked


@pytest.mark.usefixtures("as_users_have_it")
@pytest.mark.parametrize("nothing", [(), [], np.zeros((0, 4)), torch.zeros(0, 4)])
def test_keywords_replace_constraints_with_nothing_as_well(asked: list[Constraints], nothing: Any) -> None:
    own = Constraints(contact_region=((0.0, 0.0, 0.0, 0.5),), margin=1.0)
    for given in ({}, {"contact_region": None}, {"contact_region": nothing}):
        with pytest.raises(NoGraspError):
            GraspPredictor().predict(load_hand("gripper3"), load_object("sphere"), 1, constraints=own, **given)
    assert asked == [own, own, Constraints(margin=1.0)]


@pytest.mark.usefixtures("as_users_have_it")
@pytest.mark.parametrize("make", [np.array, torch.tensor, list])
def test_constraints_are_given_as_any_kind_of_rows(asked: list[Constraints], make: Callable[[Any], Any]) -> None:
    direction, region = make([0.0, 0.0, -1.0]), make([[0.0, 0.0, 0.0, 0.5]])
    with pytest.raises(NoGraspError):
        GraspPredictor().predict(
            load_hand("gripper3"), load_object("sphere"), 1, direction=direction, contact_region=region)
    assert asked == [Constraints((0.0, 0.0, -1.0), contact_region=((0.0, 0.0, 0.0, 0.5),))]
