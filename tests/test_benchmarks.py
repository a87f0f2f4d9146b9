"""The measures that benchmarks define themselves."""

from __future__ import annotations

import dataclasses
import math
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.tiny_bundle import made_up_grasps
from tests.helpers.toy_hand import toy_hand


@pytest.fixture(autouse=True)
def benchmarks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parent.parent / "benchmarks"))


def test_counterparts_lie_on_the_same_part_of_the_hand() -> None:
    counterparts = import_module("counterparts").counterparts
    hand, other = loaded_hand("allegro"), loaded_hand("leaphand")
    assert torch.equal(counterparts(hand, hand), torch.arange(hand.n_points))
    index = counterparts(hand, other)
    on_palm, lands_on_palm = hand.link_index == hand.palm, other.link_index[index] == other.palm
    assert float(lands_on_palm[on_palm].float().mean()) > 0.6
    tips = torch.isin(hand.link_index, torch.tensor(hand.tips))
    assert float(lands_on_palm[tips].float().mean()) < 0.1


def test_palm_angles_are_scipys() -> None:
    palm_angles, hand = import_module("directions").palm_angles, toy_hand()
    grasps = made_up_grasps(hand, count=15)
    requested = np.array([1.0, 2.0, -2.0])
    turned = Rotation.from_matrix(grasps.T_object_wrist[:, :3, :3].numpy()).apply(hand.palm_direction_wrist.numpy())
    np.testing.assert_allclose(palm_angles(hand, grasps, (1.0, 2.0, -2.0)), np.arccos(turned @ requested / 3), atol=1e-5)
    twice = dataclasses.replace(grasps[[0]], T_object_wrist=torch.eye(4)[None])
    opposite = tuple((-hand.palm_direction_wrist).tolist())
    assert float(palm_angles(hand, twice, opposite)) == pytest.approx(math.pi, abs=1e-5)
