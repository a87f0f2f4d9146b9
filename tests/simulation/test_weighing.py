"""Weighing beside trials with each mass, and payloads beside what a mass did."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import complete
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel, with_mass
from dro_grasp.simulation.grasp_state import WeightConfig
from dro_grasp.simulation.payload import PayloadConfig
from dro_grasp.simulation.protocols import CARRY
from dro_grasp.simulation.rollout import ObjectState, Rollout
from dro_grasp.simulation.trial import simulate
from dro_grasp.simulation.weighing import LESS, WeighingConfig, observed
from tests.helpers.claw import power_grasp
from tests.helpers.one_object import weigh

NOTHING_ADDED = WeightConfig(margin=0.0)
FINE = WeighingConfig(rounds=8)


@pytest.fixture(scope="module")
def grasps(hand: Hand, obj: ObjectModel) -> GraspBatch:
    """Three grasps that press more and more, with a guess of 0.5 kg."""
    made = complete(hand, power_grasp(hand, obj, 3), torch.zeros(3))
    share = torch.tensor([0.3, 0.6, 1.0])[:, None]
    squeeze = made.joints + share * (made.squeeze_joints - made.joints)
    return made.replace(squeeze_joints=squeeze, payload=torch.full((3,), 0.5))


def by_trials(hand: Hand, obj: ObjectModel, grasps: GraspBatch) -> torch.Tensor:
    """The largest mass that holds in trials with the squeeze as it is, by halving each grasp's interval."""
    found = []
    for i in range(len(grasps)):
        low, high = math.log(0.01), math.log(20.0)
        for _ in range(7):
            middle = (low + high) / 2
            held = bool(simulate(hand, with_mass(obj, math.exp(middle)), grasps[[i]], CARRY).success)
            low, high = (middle, high) if held else (low, middle)
        found.append(math.exp((low + high) / 2))
    return torch.tensor(found)


def test_weighing_says_what_trials_say(hand: Hand, obj: ObjectModel, grasps: GraspBatch) -> None:
    truth = by_trials(hand, obj, grasps)
    assert float(truth.max() / truth.min()) > 1.3, "the grasps differ"
    found = weigh(hand, obj, grasps, weight=NOTHING_ADDED, config=FINE)
    assert found.tolist() == pytest.approx(truth.tolist(), rel=0.25)
    for guess in (0.05, 5.0):
        other = weigh(hand, obj, grasps.replace(payload=torch.full((3,), guess)), weight=NOTHING_ADDED, config=FINE)
        assert other.tolist() == pytest.approx(truth.tolist(), rel=0.3), "wherever the search begins"


def test_what_has_gone_too_far_is_not_pulled_on(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    pulled, pull = [], Rollout.pull

    def noted(rollout: Rollout, rows: np.ndarray, force: np.ndarray, seconds: float, begin: object = None) -> ObjectState:
        state = pull(rollout, rows, force, seconds, begin)
        gone = state.shift(rollout.start.rows(rows)) >= CARRY.max_displacement
        gone |= state.turn(rollout.start.rows(rows)) >= CARRY.max_rotation
        pulled.append((begin is None, rows.tolist(), rows[~gone].tolist()))
        return state

    monkeypatch.setattr(Rollout, "pull", noted)
    weigh(hand, obj, grasps.replace(payload=torch.tensor([0.05, 0.5, 5.0])), weight=NOTHING_ADDED, config=FINE)
    firsts = [(left, len(rows)) for again, rows, left in pulled if not again]
    assert [rows for again, rows, _ in pulled if again] == [left for left, _ in firsts if left]
    assert 0 < sum(len(left) for left, _ in firsts) < sum(count for _, count in firsts)


def test_company_and_unknown_payloads_change_nothing(hand: Hand, obj: ObjectModel, grasps: GraspBatch) -> None:
    together = weigh(hand, obj, grasps)
    partly = weigh(hand, obj, grasps.replace(payload=torch.tensor([0.5, math.nan, 0.5])))
    assert partly.isnan().tolist() == [False, True, False]
    assert torch.equal(partly[[0, 2]], together[[0, 2]])
    assert weigh(hand, obj, grasps[:0]).shape == (0,)


def test_payloads_stay_within_bounds(hand: Hand, obj: ObjectModel, grasps: GraspBatch) -> None:
    away = grasps.replace(squeeze_joints=grasps.pregrasp_joints)
    assert weigh(hand, obj, away, weight=NOTHING_ADDED, config=WeighingConfig(rounds=12)).tolist() == [0, 0, 0]
    weak = replace(NOTHING_ADDED, payload=PayloadConfig(most=0.05))
    assert weigh(hand, obj, grasps, weight=weak).tolist() == pytest.approx([0.05] * 3)


def test_payloads_agree_with_what_a_mass_did() -> None:
    limit, turn = CARRY.max_displacement, CARRY.max_rotation
    gave = torch.tensor([[0.5 * limit, 0.5 * turn], [0.5 * limit, 2 * turn], [2 * limit, 0.0], [math.nan, math.nan]])
    gave = gave.repeat(2, 1)
    payload = torch.tensor([0.1] * 4 + [0.9] * 4)
    expected = [0.3, 0.1, 0.1, 0.1, 0.9, LESS * 0.3, LESS * 0.3, 0.9]
    assert observed(payload, gave, 0.3).tolist() == pytest.approx(expected)
