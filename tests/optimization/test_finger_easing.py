"""Eased fingers against a ball, whose distance is known."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from dro_grasp.energy.grasp_energy import EnergyConfig, GraspEnergy
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.optimization.finger_easing import EasingConfig, ease_fingers
from tests.helpers.claw import ball, grasps_of, wrist_below
from tests.helpers.toy_hand import toy_hand

HAND, RADIUS, CONFIG = toy_hand(), 0.03, EasingConfig()
BALL = ball(RADIUS)
ENERGY = GraspEnergy.of_object(HAND, BALL, EnergyConfig(hand_points=HAND.n_points))
TOUCHING = torch.tensor([-0.1, 0.62, 0.1, 0.62, 0.1, 0.62])
OPENED = torch.tensor([-0.4, 0.1, -0.3, 0.1, -0.3, 0.1])


def complete(joints: torch.Tensor, opened: torch.Tensor, height: float = 0.05) -> GraspBatch:
    grasps = grasps_of(HAND, BALL, wrist_below(height), joints[None])
    return grasps.replace(pregrasp_joints=opened[None], squeeze_joints=joints[None] + 0.1)


def gaps(grasps: GraspBatch) -> torch.Tensor:
    """Distance of each finger's nearest point to the ball, by plain geometry (fingers) [m]."""
    points = HAND.points(grasps.joints, grasps.T_object_wrist).norm(dim=-1) - RADIUS
    return torch.stack([points[0, torch.isin(HAND.link_index, torch.tensor(f.links))].amin() for f in HAND.fingers])


def test_fingers_open_until_they_stand_clear_and_nothing_else_moves() -> None:
    before = complete(TOUCHING, OPENED)
    assert float(gaps(before).max()) < CONFIG.clearance
    after = ease_fingers(ENERGY, before)
    step = torch.stack([gaps(before.replace(joints=before.joints + s * (before.pregrasp_joints - before.joints)))
                        for s in torch.linspace(0, 1, CONFIG.steps)])
    assert float(gaps(after).min()) >= CONFIG.clearance - 7e-4
    assert bool((gaps(after) <= CONFIG.clearance + step.diff(dim=0).amax(0) + 7e-4).all()), "no farther than a step beyond"
    for name in ("T_object_wrist", "pregrasp_joints", "squeeze_joints"):
        assert torch.equal(getattr(after, name), getattr(before, name))


def test_a_finger_that_is_clear_stays_while_others_open() -> None:
    joints = TOUCHING.clone()
    joints[:2] = OPENED[:2]
    before = complete(joints, OPENED - 0.05)
    assert float(gaps(before)[0]) > CONFIG.clearance
    after = ease_fingers(ENERGY, before)
    assert torch.equal(after.joints[0, :2], joints[:2])
    assert bool((after.joints[0, [3, 5]] < joints[[3, 5]]).all())


def test_where_the_pregrasp_leaves_no_room_a_finger_goes_where_it_is_clearest() -> None:
    little, deeper = TOUCHING.clone(), TOUCHING.clone()
    little[3] -= 0.02
    deeper[3] += 0.2
    for opened, share in ((little, 1.0), (deeper, 0.0)):
        before = complete(TOUCHING, opened)
        after = ease_fingers(ENERGY, before)
        assert float(gaps(after)[1]) < CONFIG.clearance
        wanted = TOUCHING + share * (opened - TOUCHING)
        assert torch.allclose(after.joints[0], wanted, atol=1e-6)


def test_batches_do_not_matter_and_none_stay_none() -> None:
    both = GraspBatch.concatenate([complete(TOUCHING, OPENED), complete(TOUCHING - 0.05, OPENED), complete(TOUCHING, OPENED)])
    whole = ease_fingers(ENERGY, both)
    assert torch.equal(ease_fingers(ENERGY, both, replace(CONFIG, batch_size=1)).joints, whole.joints)
    assert not torch.equal(whole.joints, both.joints)
    assert len(ease_fingers(ENERGY, both[slice(0, 0)])) == 0
    wide = ease_fingers(ENERGY, both, replace(CONFIG, clearance=0.01))
    assert float(gaps(wide[0]).min()) == pytest.approx(0.0115, abs=0.0022)
