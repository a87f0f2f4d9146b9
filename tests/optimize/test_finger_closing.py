"""Idle fingers against a ball, whose distance is known, and a slow scan of their way."""

from __future__ import annotations

from copy import copy

import pytest
import torch

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.optimize.fingers import ClosingConfig, close_idle_fingers
from dro_grasp.optimize.grasp_energy import EnergyConfig, GraspEnergy
from dro_grasp.optimize.terms import SpherePairs
from tests.helpers.claw import ball, grasps_of, wrist_below
from tests.helpers.toy_hand import toy_hand

HAND, RADIUS, CONFIG = toy_hand(), 0.03, ClosingConfig()
BALL = ball(RADIUS)
ENERGY = GraspEnergy.of_object(HAND, BALL, EnergyConfig(hand_points=HAND.n_points))


def grasp(*joints: float, height: float = 0.05) -> GraspBatch:
    return grasps_of(HAND, BALL, wrist_below(height), torch.tensor([joints]))


def gaps(grasps: GraspBatch) -> torch.Tensor:
    """Distance of each finger's nearest point to the ball, by plain geometry (n fingers) [m]."""
    points = HAND.points(grasps.joints, grasps.T_object_wrist).norm(dim=-1) - RADIUS
    return torch.stack([points[:, torch.isin(HAND.link_index, torch.tensor(f.links))].amin(1) for f in HAND.fingers], 1)


def test_an_idle_finger_stops_where_it_first_meets_the_object() -> None:
    before = grasp(-0.3, 0.2, 0.1, 0.62, 0.1, 0.62)
    assert float(gaps(before)[0, 0]) > 0.01
    assert float(gaps(before)[0, 1:].max()) < CONFIG.idle
    after = close_idle_fingers(ENERGY, before)
    assert torch.equal(after.joints[:, 2:], before.joints[:, 2:])
    assert torch.equal(after.T_object_wrist, before.T_object_wrist)
    assert float(gaps(after)[0, 0]) == pytest.approx(CONFIG.contact, abs=7e-4)
    start, end = before.joints[0, :2], after.joints[0, :2]
    share = (end - start) / (HAND.closed_ends[:2] - start)
    assert float(share[0]) == pytest.approx(float(share[1]), abs=1e-5)
    for part in torch.linspace(0, 0.98, 60):  # nothing was met on the way
        q = before.joints.clone()
        q[0, :2] = start + part * (end - start)
        assert float(gaps(before.with_poses(before.T_object_wrist, q))[0, 0]) > CONFIG.contact - 7e-4


def test_a_finger_that_is_bent_too_far_comes_from_its_open_posture() -> None:
    before = grasp(-0.1, 0.5, -0.1, 0.5, 1.4, 1.4, height=0.085)
    assert float(gaps(before)[0, 2]) > CONFIG.idle, "it lies on the palm, below the ball"
    after = close_idle_fingers(ENERGY, before)
    assert float(gaps(after)[0, 2]) == pytest.approx(CONFIG.contact, abs=7e-4)
    assert float(after.joints[0, 4]) < 1.0


def test_fingers_that_reach_nothing_stay() -> None:
    far = grasp(0.0, 0.3, 0.1, 0.4, 0.2, 0.5, height=0.3)
    assert torch.equal(close_idle_fingers(ENERGY, far).joints, far.joints)
    assert len(close_idle_fingers(ENERGY, far[slice(0, 0)])) == 0


def test_a_finger_that_reaches_nothing_rests_as_bent_as_the_one_that_holds() -> None:
    before = grasp(-0.2, -0.1, -0.3, 0.2, -0.3, 0.2)
    T = before.T_object_wrist.clone()
    T[0, 0, 3] += 0.06  # only finger 0 reaches the ball, across the palm
    before = before.with_poses(T, before.joints)
    after = close_idle_fingers(ENERGY, before)
    holds, beside, last = after.joints[0].reshape(3, 2)
    assert float(gaps(after)[0, 0]) == pytest.approx(CONFIG.contact, abs=7e-4)
    as_bent = float(holds.mean())  # all joints of this hand have the same range
    assert beside.tolist() == pytest.approx([as_bent, as_bent], abs=1e-5)
    assert float(gaps(after)[0, 1:].min()) > CONFIG.contact
    # The third would touch the second, and rests before it.
    assert last[0] == last[1]
    assert -0.05 < float(last[0]) < as_bent - 0.05
    alone = close_idle_fingers(ENERGY, before, ClosingConfig(rest_shares=(1.0,)))
    assert torch.equal(alone.joints[0, 4:], before.joints[0, 4:])
    assert torch.equal(close_idle_fingers(ENERGY, before, ClosingConfig(rest_shares=())).joints[0, 2:], before.joints[0, 2:])


def test_a_finger_that_is_bent_more_than_those_that_hold_stays() -> None:
    before = grasp(-0.2, -0.1, 0.3, 0.6, -0.3, 0.2)
    T = before.T_object_wrist.clone()
    T[0, 0, 3] += 0.06
    before = before.with_poses(T, before.joints)
    after = close_idle_fingers(ENERGY, before)
    assert float(gaps(after)[0, 0]) == pytest.approx(CONFIG.contact, abs=7e-4)
    assert torch.equal(after.joints[0, 2:4], before.joints[0, 2:4])


def test_outer_links_wrap_around_an_object_that_inner_links_touch() -> None:
    before = grasp(0.05, -0.5, 0.05, -0.4, 0.05, -0.3, height=0.04)
    outer = torch.isin(HAND.link_index, torch.tensor([f.tip for f in HAND.fingers]))

    def least(grasps: GraspBatch, points: torch.Tensor) -> float:
        return float((HAND.points(grasps.joints, grasps.T_object_wrist).norm(dim=-1) - RADIUS)[0, points].min())

    assert float(gaps(before).max()) < CONFIG.idle < least(before, outer)
    after = close_idle_fingers(ENERGY, before)
    assert torch.equal(after.joints[:, ::2], before.joints[:, ::2]), "inner links touch already"
    assert bool((after.joints[:, 1::2] > before.joints[:, 1::2]).all())
    for finger in HAND.fingers:
        assert least(after, HAND.link_index == finger.tip) == pytest.approx(CONFIG.contact, abs=7e-4)


def test_an_outer_link_that_meets_nothing_bends_as_the_fingers_that_hold() -> None:
    before = grasp(0.4, -0.3, 0.6, 0.3, 0.6, 0.3, height=0.04)
    T = before.T_object_wrist.clone()
    T[0, 0, 3] -= 0.07  # the back of finger 0 touches the ball
    before = before.with_poses(T, before.joints)
    assert float(gaps(before)[0, 0]) < CONFIG.idle
    after = close_idle_fingers(ENERGY, before)
    assert float(after.joints[0, 1]) == pytest.approx((0.4 - 0.3) / 2, abs=1e-5)
    assert torch.equal(after.joints[0, [0, 2, 3, 4, 5]], before.joints[0, [0, 2, 3, 4, 5]])


def test_fingers_do_not_close_into_each_other() -> None:
    """Fingers of 6 cm in radius, which overlap when they close: spheres stand for the links."""
    energy = copy(ENERGY)
    energy.pairs = SpherePairs.of(torch.full_like(ENERGY.spheres.radii, 0.06), ENERGY.spheres.pairs)
    before = grasp(-0.3, 0.2, 0.1, 0.62, 0.1, 0.62)
    assert torch.equal(close_idle_fingers(energy, before).joints, before.joints)
    careless = close_idle_fingers(energy, before, ClosingConfig(overlap=1.0))
    assert float(gaps(careless)[0, 0]) == pytest.approx(CONFIG.contact, abs=7e-4)


def test_the_batch_size_changes_nothing() -> None:
    one, other = grasp(-0.3, 0.2, 0.1, 0.62, 0.1, 0.62), grasp(0.1, 0.62, -0.2, 0.1, 0.1, 0.62)
    both = GraspBatch.concatenate([one, other])
    apart = torch.cat([close_idle_fingers(ENERGY, x).joints for x in (one, other)])
    torch.testing.assert_close(close_idle_fingers(ENERGY, both).joints, apart)
    torch.testing.assert_close(close_idle_fingers(ENERGY, both, ClosingConfig(batch_size=1)).joints, apart)
