"""Eased fingers against a ball, whose distance is known."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.optimize import fingers
from dro_grasp.optimize.fingers import EasingConfig, ease_fingers, missing_clearance
from dro_grasp.optimize.grasp_energy import EnergyConfig, GraspEnergy
from tests.helpers.claw import ball, grasps_of, wrist_below
from tests.helpers.toy_hand import coupled_hand, toy_hand

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


def test_fingers_leave_more_room_where_the_surface_is_a_guess_and_no_more_where_it_was_seen() -> None:
    before = complete(TOUCHING, OPENED - 0.3)
    points = HAND.points(before.joints, before.T_object_wrist)[0]
    first = points[torch.isin(HAND.link_index, torch.tensor(HAND.fingers[0].links))]
    cloud = torch.from_numpy(BALL.cloud)
    seen = cloud[torch.cdist(cloud, first).amin(1) < 0.01]
    assert 0 < len(seen) < len(cloud) / 3
    plain, after = ease_fingers(ENERGY, before), ease_fingers(ENERGY, before, seen.numpy())
    assert torch.equal(after.joints[0, :2], plain.joints[0, :2])
    assert float(gaps(plain)[1:].max()) < 0.008
    for unseen in (CONFIG.unseen, 0.008):
        after = ease_fingers(ENERGY, before, seen.numpy(), replace(CONFIG, unseen=unseen))
        points = HAND.points(after.joints, after.T_object_wrist)[0]
        away = points.norm(dim=-1) - RADIUS
        wanted = (torch.cdist(points, seen).amin(1) - away).clamp(CONFIG.clearance, unseen)
        others = torch.isin(HAND.link_index, torch.tensor([link for f in HAND.fingers[1:] for link in f.links]))
        assert float((away - wanted)[others].min()) > -7e-4
        assert float(gaps(after)[1:].min()) > 0.0075
    assert float(gaps(after)[1:].max()) < 0.0115
    everywhere = ease_fingers(ENERGY, before, cloud.numpy())
    assert torch.equal(everywhere.joints, plain.joints), "nothing is a guess"


@pytest.mark.parametrize("part", ["all", "top", "none"])
def test_the_lacking_room_is_that_of_every_point_of_the_opened_hand(part: str) -> None:
    both = GraspBatch.concatenate([complete(TOUCHING, TOUCHING), complete(TOUCHING, OPENED), complete(TOUCHING, OPENED, 0.3)])
    cloud = torch.from_numpy(BALL.cloud)
    seen = {"all": cloud, "top": cloud[cloud[:, 2] > 0.02], "none": None}[part]
    given = None if seen is None else seen.numpy()
    expected = []
    for T, q in zip(both.T_object_wrist, both.pregrasp_joints, strict=True):
        wanted = []
        for point in HAND.points(q[None], T[None])[0]:
            distance = float(point.norm()) - RADIUS
            guess = 0.0 if seen is None else float((seen - point).norm(dim=-1).min()) - max(distance, 0.0)
            wanted.append(min(max(guess, CONFIG.clearance), CONFIG.unseen) - distance)
        expected.append(max(0.0, *wanted))
    found = missing_clearance(ENERGY, both, given)
    assert found.tolist() == pytest.approx(expected, abs=7e-4)
    assert expected[0] > 0.002
    assert expected[2] == 0
    assert torch.equal(missing_clearance(ENERGY, both, given, replace(CONFIG, batch_size=1)), found)
    assert len(missing_clearance(ENERGY, both[:0], given)) == 0


def test_a_finger_that_is_clear_stays_while_others_open() -> None:
    joints = TOUCHING.clone()
    joints[:2] = OPENED[:2]
    before = complete(joints, OPENED - 0.05)
    assert float(gaps(before)[0]) > CONFIG.clearance
    after = ease_fingers(ENERGY, before)
    assert torch.equal(after.joints[0, :2], joints[:2])
    assert bool((after.joints[0, [3, 5]] < joints[[3, 5]]).all())


def test_a_finger_that_finds_no_room_beside_a_guess_comes_no_nearer_to_the_surface(monkeypatch: pytest.MonkeyPatch) -> None:
    gaps = iter([0.0045, *torch.linspace(0.0039, 0.001, CONFIG.steps - 1).tolist()])
    spares = iter(torch.linspace(-0.02, -0.01, CONFIG.steps).tolist())
    before = complete(TOUCHING, OPENED)
    ones = torch.ones(1, len(ENERGY.body.members))
    monkeypatch.setattr(fingers, "_clearance", lambda *_: (next(gaps) * ones, next(spares) * ones))
    assert torch.equal(ease_fingers(ENERGY, before, BALL.cloud).joints, TOUCHING[None])


def test_fingers_that_share_their_joints_open_until_all_stand_clear() -> None:
    hand = coupled_hand()
    energy = GraspEnergy.of_object(hand, BALL, EnergyConfig(hand_points=hand.n_points))
    T = wrist_below(0.05)
    T[0, 0, 3] = -0.004  # nearer to one finger than to the others
    touching, opened = torch.tensor([[0.06, 0.58]]), torch.tensor([[-0.4, 0.1]])
    before = grasps_of(hand, BALL, T, touching).replace(pregrasp_joints=opened, squeeze_joints=touching + 0.1)
    after = ease_fingers(energy, before)

    def nearest(joints: torch.Tensor) -> float:
        return float(hand.points(joints, T).norm(dim=-1).amin()) - RADIUS

    assert nearest(touching) < 0.002
    assert CONFIG.clearance - 7e-4 < nearest(after.joints)
    share = (after.joints - touching) / (opened - touching)
    assert float(share[0, 0]) == pytest.approx(float(share[0, 1]), abs=1e-6)
    assert nearest(touching + (share - 0.1) * (opened - touching)) < CONFIG.clearance + 7e-4


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
    assert torch.equal(ease_fingers(ENERGY, both, config=replace(CONFIG, batch_size=1)).joints, whole.joints)
    assert not torch.equal(whole.joints, both.joints)
    assert len(ease_fingers(ENERGY, both[slice(0, 0)])) == 0
    wide = ease_fingers(ENERGY, both, config=replace(CONFIG, clearance=0.01))
    assert float(gaps(wide[0]).min()) == pytest.approx(0.0115, abs=0.0022)
