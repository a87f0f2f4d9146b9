"""What a shortage of grasps advises."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.admission import PLANE, TURNED, shortage_in_words
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.problem import GraspProblem
from tests.helpers.toy_hand import toy_hand

BALL = load_object("sphere")
SEEN_ON_A_TABLE = dataclasses.replace(BALL, vertices=None, faces=None, table=np.array([0.0, 0.0, 1.0, -0.2], np.float32))


@pytest.mark.parametrize(
    ("obj", "table", "reason", "said"),
    [(SEEN_ON_A_TABLE, None, PLANE, "state the table's height if it is lower than the one found in the cloud"),
     (SEEN_ON_A_TABLE, -0.3, PLANE, "lower table (now -0.3 m"),
     (SEEN_ON_A_TABLE, None, TURNED, "Try another seed")])
def test_a_table_is_named_where_it_was_given_or_found(obj: ObjectModel, table: float | None, reason: str, said: str) -> None:
    problem = GraspProblem(toy_hand(), obj, constraints=Constraints(table=table))
    words = shortage_in_words(problem, 2, 1, 2, {reason: 1}, alone=False)
    assert said in words
    assert ("found in the cloud" in words) == ("found in the cloud" in said)
