"""What to expect of a hold: closings of a claw on a ball and on nothing, as MuJoCo has them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from dro_grasp.grasps.batch import GraspBatch, load_grasps
from dro_grasp.grasps.columns import HOLD_COLUMNS
from dro_grasp.grasps.controller import complete
from dro_grasp.grasps.hold import HoldExpectation, check_hold
from dro_grasp.hands.effort import find_efforts
from dro_grasp.hands.hand import Hand
from dro_grasp.simulation.conditions import draw
from dro_grasp.simulation.holding import closing_of, expect_hold, rest
from dro_grasp.simulation.protocols import ROBUST
from dro_grasp.simulation.rollout import Rollout
from dro_grasp.simulation.scene import scene_of
from tests.helpers.claw import ball, power_grasp

RADIUS = 0.04  # Of the ball [m]; between smaller ones the fingers meet each other


@pytest.fixture(scope="module")
def grasps(hand: Hand) -> GraspBatch:
    obj = ball(RADIUS)
    return complete(hand, power_grasp(hand, obj), torch.as_tensor(obj.centre_of_mass, dtype=torch.float32))


@pytest.fixture(scope="module")
def told(hand: Hand, grasps: GraspBatch) -> GraspBatch:
    return expect_hold(hand, ball(RADIUS), grasps, workers=1)


def test_an_empty_hand_closes_as_if_there_were_no_object(hand: Hand, grasps: GraspBatch, told: GraspBatch) -> None:
    """A crumb far away, which no finger meets, stands for nothing at all."""
    crumb, far = ball(0.001, "crumb"), grasps.T_object_wrist.clone()
    far[:, 2, 3] -= 3.0
    alone = GraspBatch.create(
        hand, crumb, far, grasps.joints, pregrasp_joints=grasps.pregrasp_joints, squeeze_joints=grasps.squeeze_joints)
    joints, efforts = rest(Rollout(scene_of(hand, crumb, alone, closing_of("carry")), alone, 1), alone)
    expected = HoldExpectation.of(told, 0)
    assert expected is not None
    np.testing.assert_allclose(expected.empty_joints, joints[0], atol=2e-3)
    np.testing.assert_allclose(expected.empty_efforts, efforts[0], atol=0.02)


def test_fingers_stop_on_the_object_and_press(hand: Hand, grasps: GraspBatch, told: GraspBatch) -> None:
    expected, target = HoldExpectation.of(told, 0), grasps.squeeze_joints[0].double().numpy()
    assert expected is not None
    short = target - expected.held_joints
    assert (expected.empty_joints - expected.held_joints)[::2].min() > 0.2, "the knuckles go on without the ball"
    stiffness, most = closing_of("carry").stiffness, find_efforts(hand).limit.double().numpy()
    np.testing.assert_allclose(expected.held_efforts, np.clip(stiffness * short, -most, most), atol=1e-3)
    assert np.abs(expected.held_efforts).max() > 0.3


def test_columns_travel_in_files_and_nothing_is_known_without_them(grasps: GraspBatch, told: GraspBatch, tmp_path) -> None:
    assert HoldExpectation.of(grasps, 0) is None
    told.save(tmp_path / "grasps.parquet")
    again, expected = HoldExpectation.of(load_grasps(tmp_path / "grasps.parquet"), 0), HoldExpectation.of(told, 0)
    assert again is not None
    assert expected is not None
    np.testing.assert_allclose(again.held_joints, expected.held_joints, atol=1e-6)
    assert again.weight == pytest.approx(9.81 * ball(RADIUS).mass, rel=1e-5)
    mixed = GraspBatch.concatenate([told, grasps])
    assert set(HOLD_COLUMNS) <= set(mixed.extra)
    assert HoldExpectation.of(mixed, len(told)) is None
    torch.testing.assert_close(told.joints, grasps.joints)


def test_closings_under_unknown_conditions_are_told_apart(hand: Hand, told: GraspBatch) -> None:
    obj, rng = ball(RADIUS), np.random.default_rng(0)
    config = replace(ROBUST, trials=5, needed=1, coarse=0)
    conditions = draw(config, told)
    many = GraspBatch.concatenate([told] * (config.trials - 1))
    scene, expected = scene_of(hand, obj, many, closing_of("carry")), HoldExpectation.of(told, 0)
    assert expected is not None
    for empty, state in ((False, "held"), (True, "empty")):
        joints = rest(Rollout(scene, many, 1, conditions=conditions), many, empty)[0].numpy()
        noisy = joints + 0.01 * expected.unit * rng.normal(size=joints.shape)
        assert [check_hold(expected, row).state for row in noisy] == [state] * len(many)
