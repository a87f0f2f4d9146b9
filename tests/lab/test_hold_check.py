"""Closings of a claw on a ball, and a ball that slides out of it or is torn away."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import torch

from dro_grasp.grasps.controller import complete
from dro_grasp.grasps.hold import HoldCheck
from lab.benchmarks.hold_check import KINDS, NOISES, ROWS, Measured, calibration, counted, judged, situations
from tests.helpers.claw import ball, claw, power_grasp

RADIUS = 0.04  # [m]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> list[Measured]:
    hand, obj = claw(tmp_path_factory.mktemp("hand")), ball(RADIUS)
    grasps = complete(hand, power_grasp(hand, obj), torch.as_tensor(obj.centre_of_mass, dtype=torch.float32))
    return situations(hand, "claw4", obj, grasps, np.random.default_rng(0))


def test_every_situation_is_met_and_joints_and_loads_are_what_they_should_be(found: list[Measured]) -> None:
    kinds = Counter(one.kind for one in found)
    assert set(kinds) == set(KINDS)
    assert kinds["held"] == kinds["empty"]
    weight = found[0].expected.weight
    assert weight is not None
    assert weight == pytest.approx(9.81 * ball(RADIUS).mass, rel=1e-5)
    moved = {kind: [np.abs(one.watched[-1] - one.watched[0]).max() for one in found if one.kind == kind] for kind in KINDS}
    assert max(moved["empty"]) == 0.0
    assert max(moved["held"]) < 0.01 < min(moved["slides"] + moved["torn"])
    for one in found:
        assert one.watched.shape == (ROWS, len(one.joints))
        assert one.load == 0.0 if one.kind == "empty" else 0.0 < one.load < 60 * weight
        if one.kind == "held":  # as heavy as `robust` draws it
            assert 0.5 * weight <= one.load <= 2.0 * weight


def test_judgements_are_counted_by_hand_and_kind_and_by_confidence(found: list[Measured]) -> None:
    said = judged(found, "typical", "watched", 0)
    assert [check.state for check in said] == [KINDS[one.kind] for one in found], "the claw is easy"
    for how in ("once", "twice, efforts", "watched, load"):
        assert all(len(judged(found, noise, how, 0)) == len(found) for noise in NOISES)
    said = [HoldCheck("held", 0.7 if k % 2 else 0.99, {}) for k in range(len(found))]
    rows = counted(found, said, ("typical", "once"))
    assert sum(int(str(row[5])) for row in rows if row[0] == "all") == len(found)
    held, torn = (next(row for row in rows if row[0] == "claw4" and row[3] == kind) for kind in ("held", "torn"))
    assert (held[4], held[6:9]) == ("held", [held[5], 0, 0])
    assert (torn[4], torn[6:9]) == ("slipping", [torn[5], 0, 0])
    bins = calibration(found, said, ("typical", "once"))
    assert [row[3] for row in bins] == pytest.approx([0.7, 0.99])
    assert sum(int(str(row[2])) for row in bins) == len(found)
