"""The hand and the object of most trials."""

from __future__ import annotations

import pytest

from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from tests.helpers.claw import ball, claw


@pytest.fixture(scope="module")
def hand(tmp_path_factory: pytest.TempPathFactory) -> Hand:
    return claw(tmp_path_factory.mktemp("hand"))


@pytest.fixture(scope="module")
def obj() -> ObjectModel:
    return ball()
