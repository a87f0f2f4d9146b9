"""Synthesis: where it starts, that the energy falls, that results repeat, and that physics agrees."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dro_grasp.errors import ObjectError, OptionError
from dro_grasp.grasps.batch import distinct
from dro_grasp.hands.anatomy import PALM
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimize.contacts import contact_candidates
from dro_grasp.optimize.grasp_energy import GraspEnergy, link_spheres
from dro_grasp.optimize.starts import StartConfig, approach, draw_starts
from dro_grasp.optimize.synthesis import Chances, SynthesisConfig, anneal, depth, synthesize
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.toy_hand import toy_hand

SHORT = SynthesisConfig(steps=60, batch_size=32)


@pytest.fixture(scope="module")
def ball() -> ObjectModel:
    return load_object("sphere")


def test_candidates_face_inwards_and_slots_keep_to_their_fingers():
    hand = toy_hand()
    candidates = contact_candidates(hand)
    assert candidates.slot_finger == (0, 1, 2, PALM)
    drawn = candidates.draw(200, torch.Generator().manual_seed(0))
    for slot in range(3):
        assert (candidates.fingers[drawn[:, slot]] == slot).all()
    assert len(candidates.fingers[drawn[:, 3]].unique()) > 1
    fingers = candidates.fingers != PALM
    assert (candidates.normals[fingers, 0] < 0.5).all()  # the outer faces of the fingers look along +x


def test_spheres_lie_in_their_links_and_may_not_meet_across_fingers():
    hand = toy_hand()
    spheres = link_spheres(hand)
    for link in range(hand.tree.n_links):
        points = hand.link_points[hand.link_index == link]
        inside = spheres.centres[spheres.links == link]
        assert (inside >= points.amin(0) - 1e-6).all()
        assert (inside <= points.amax(0) + 1e-6).all()
    pairs = {tuple(sorted(p)) for p in spheres.links[spheres.pairs].tolist()}
    assert (2, 4) in pairs
    assert (1, 2) not in pairs  # neighbours


@pytest.mark.parametrize("name", ["allegro", "leaphand", pytest.param("assets/allegro_left", marks=pytest.mark.assets)])
def test_all_spheres_of_two_fingers_are_to_be_kept_apart(name: str, request: pytest.FixtureRequest):
    """Also those that overlap at the open ends, where fingers of these hands cross."""
    if name.startswith("assets/"):
        request.getfixturevalue("assets_folder")
    hand = loaded_hand(name)
    spheres = link_spheres(hand)
    finger = hand.finger_of_link[spheres.links]

    def across(pairs: torch.Tensor) -> int:
        first, second = finger[pairs].unbind(1)
        return int(((first != second) & (first != PALM) & (second != PALM)).sum())

    assert across(spheres.pairs) == across(torch.combinations(torch.arange(len(finger)), 2)) > 100


def test_starts_face_the_object_from_all_sides_and_touch_nothing(ball):
    hand = toy_hand()
    energy = GraspEnergy.of_object(hand, ball)
    surface, config = torch.from_numpy(ball.cloud), StartConfig(gap=(0.002, 0.01))
    drawn = draw_starts(hand, surface, energy.centre, 256, config, torch.Generator().manual_seed(0))
    T, q = approach(hand, energy.field, drawn, config)
    clearance = energy.field.distances(hand.points(q, T))[0].amin(-1)
    assert clearance.min() > 0  # [m]
    centres = energy.pivot(T)
    direction = T[:, :3, :3] @ hand.palm_direction_wrist
    assert ((energy.centre - centres) * direction).sum(-1).min() > -ball.extents.max()
    assert direction.mean(0).norm() < 0.15  # uniform directions average out: 1 / sqrt(256) each way
    assert (q >= hand.tree.lower).all()
    assert (q <= hand.tree.upper).all()


def test_energy_falls_and_limits_hold(ball):
    hand = toy_hand()
    energy, surface = GraspEnergy.of_object(hand, ball, SHORT.energy, SHORT.contacts), torch.from_numpy(ball.cloud)
    generator = torch.Generator().manual_seed(0)
    start = approach(
        hand, energy.field, draw_starts(hand, surface, energy.centre, 32, SHORT.starts, generator), SHORT.starts)
    before, after = (
        anneal(energy, *start, config, Chances.draw(energy.candidates, 32, config, generator))
        for config in (SynthesisConfig(steps=1), SHORT))
    assert after.result.total.median() < 0.4 * before.result.total.median()
    assert (after.q >= hand.tree.lower).all()
    assert (after.q <= hand.tree.upper).all()
    assert depth(energy, after).median() < 0.006  # [m]
    torch.testing.assert_close(
        after.result.total, energy(after.T, after.q, after.contacts).total, atol=1e-5, rtol=1e-4)


def test_synthesis_repeats_for_a_seed_and_comes_sorted(ball):
    hand = toy_hand()
    first, again, other = (synthesize(hand, ball, 40, seed, SHORT) for seed in (3, 3, 4))
    assert torch.equal(first.T_object_wrist, again.T_object_wrist)
    assert torch.equal(first.joints, again.joints)
    assert not torch.equal(first.joints, other.joints)
    assert len(first) == 40
    assert (first.energy.diff() >= 0).all()
    terms = torch.stack([v for k, v in first.extra.items() if k.startswith("energy_")])
    torch.testing.assert_close(first.energy, terms.sum(0))
    rotation = first.T_object_wrist[:, :3, :3].double()
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).double().expand(40, 3, 3), atol=1e-5, rtol=0)


def test_impossible_requests_are_refused(ball):
    with pytest.raises(OptionError, match="at least one"):
        synthesize(toy_hand(), ball, 0)
    cloud = ObjectModel("cloud", ball.cloud, ball.cloud_normals, np.zeros(3), "x")
    with pytest.raises(ObjectError, match="mesh"):
        synthesize(toy_hand(), cloud, 4)


def test_idle_fingers_hold_nothing_and_two_always_hold():
    hand = loaded_hand("allegro")
    candidates = contact_candidates(hand)
    own = torch.arange(len(candidates.slot_finger))
    slots = candidates.assign(400, 0.5, torch.Generator().manual_seed(0))
    fingers = torch.tensor(candidates.slot_finger)[slots]
    assert (slots[:, candidates.thumb] == candidates.thumb).all()
    used = torch.stack([(fingers == i).any(-1) for i in range(len(hand.tips))], -1)
    assert (used.sum(-1) >= 2).all()
    assert used.sum(-1).unique().tolist() == [2, 3, 4]
    others = [i for i in range(4) if i != candidates.thumb]
    # Each of three is idle half the time, but not all three at once: (3 / 2 - 1 / 8) / 3.
    assert (~used).float()[:, others].mean() == pytest.approx(0.458, abs=0.04)
    assert (candidates.assign(50, 0.0, torch.Generator().manual_seed(0)) == own).all()
    assert (contact_candidates(toy_hand()).assign(50, 0.9, torch.Generator().manual_seed(0)) == torch.arange(4)).all()


def test_energy_runs_wholly_on_the_device_it_is_told(ball):
    hand = toy_hand()
    here, there = (GraspEnergy.of_object(hand, ball, device=device) for device in ("cpu", "meta"))
    T, q = torch.eye(4).repeat(5, 1, 1), torch.zeros(5, hand.tree.n_dof)
    contacts = torch.zeros(5, 4, dtype=torch.int64)
    expected, found = here(T, q, contacts), there(T.to("meta"), q.to("meta"), contacts.to("meta"))
    for name in ("terms", "by_pose", "by_joint"):
        assert getattr(found, name).device.type == "meta"
        assert getattr(found, name).shape == getattr(expected, name).shape


def test_near_duplicates_are_counted_once(ball):
    hand = toy_hand()
    grasps = synthesize(hand, ball, 8, 0, SHORT)
    shifted = grasps.replace(T_object_wrist=grasps.T_object_wrist + 0.0)
    shifted.T_object_wrist[:, 0, 3] += torch.tensor([0.004, 0.006] * 4)  # [m]
    both = type(grasps).concatenate([grasps, shifted])
    assert distinct(hand, both)[8:].tolist() == [False, True] * 4
    elsewhere = shifted.replace(object=("another",) * 8)
    assert distinct(hand, type(grasps).concatenate([grasps, elsewhere]))[8:].all()
    assert distinct(hand, shifted, earlier=grasps).tolist() == [False, True] * 4
    assert distinct(hand, elsewhere, earlier=grasps).all()


def test_physics_agrees_on_an_easy_pair():
    from dro_grasp.simulation.trial import simulate

    hand, can = loaded_hand("barrett"), load_object("can")
    best = synthesize(hand, can, 48, 0, SynthesisConfig(steps=120, batch_size=48))[slice(0, 12)]
    assert simulate(hand, can, best, "dro").success.float().mean() > 0.6
