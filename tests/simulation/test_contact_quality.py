from __future__ import annotations

import numpy as np
import pytest
import torch

from dro_grasp.errors import ObjectError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.objects.catalogue import load_object
from dro_grasp.simulation.contacts import NAMES, NO_CONTACT, REACH, measure_contacts, with_contacts
from dro_grasp.simulation.trial import simulate
from tests.helpers.claw import ball, claw, grasps_of, power_grasp, wrist_below

RADIUS = 0.007
"""Of the claw's fingers [m]."""
HULL = 5e-4
"""What the ball that collides lies within the round one, at most: it has 64 vertices [m]."""


@pytest.fixture(scope="module")
def hand(tmp_path_factory):
    return claw(tmp_path_factory.mktemp("hand"))


@pytest.fixture(scope="module")
def obj():
    return ball()


def open_hand(hand, obj, height):
    """Straight fingers beside the ball, whose middle is `height` above the palm."""
    return grasps_of(hand, obj, wrist_below(height), torch.zeros(1, 8))


def test_straight_fingers_are_as_far_from_a_ball_as_geometry_says(hand, obj):
    # Fingers are at 42 mm from the axis, the ball has 30 mm: 5 mm are left at each.
    found = measure_contacts(hand, obj, open_hand(hand, obj, 0.07))
    assert found.contact_distance.item() == pytest.approx(0.042 - 0.03 - RADIUS, abs=HULL)
    assert found.contact_spread.item() == pytest.approx(0.0, abs=HULL)
    assert found.object_penetration.item() == found.touching_links.item() == found.q1.item() == 0.0


def test_one_side_near_and_one_side_far(hand, obj):
    grasps = open_hand(hand, obj, 0.07)
    T = grasps.T_object_wrist.clone()
    T[:, 0, 3] -= 0.006  # the finger at +x comes 1 mm into the ball, the one at -x goes to 11 mm, which counts as 10
    found = measure_contacts(hand, obj, grasps.replace(T_object_wrist=T))
    sideways = np.hypot(0.042, 0.006) - 0.03 - RADIUS
    assert found.object_penetration.item() == pytest.approx(0.001, abs=HULL)
    assert found.contact_spread.item() == pytest.approx(REACH + 0.001, abs=HULL)
    assert found.contact_distance.item() == pytest.approx((0 + REACH + 2 * sideways) / 4, abs=HULL)
    assert found.touching_links.item() == 1


def test_four_fingers_around_the_equator_have_force_closure_and_a_far_hand_has_nothing(hand):
    fitting = ball(0.042 - RADIUS, "fitting")
    grasps = GraspBatch.concatenate([open_hand(hand, fitting, height) for height in (0.07, 0.3)])
    found = measure_contacts(hand, fitting, grasps)
    assert found.q1[0] > 0.1
    assert found.wrench_error[0] < 0.01
    assert found.touching_links[0] == 4
    assert (found.q1[1], found.wrench_error[1], found.contact_distance[1]) == (0.0, NO_CONTACT, pytest.approx(REACH))
    # That protocol has more friction.
    assert measure_contacts(hand, fitting, grasps, "dro").q1[0] > found.q1[0]


def test_the_simulation_does_not_see_what_was_measured(hand, obj):
    grasps = power_grasp(hand, obj, 2)
    before = simulate(hand, obj, grasps, "dexgraspbench")
    measure_contacts(hand, obj, grasps)
    assert torch.equal(before.displacement, simulate(hand, obj, grasps, "dexgraspbench").displacement)


def test_columns_are_saved_and_read(hand, obj, tmp_path):
    measured = with_contacts(hand, obj, power_grasp(hand, obj, 2))
    measured.save(tmp_path / "grasps.parquet")
    read = GraspBatch.load(tmp_path / "grasps.parquet")
    for name in NAMES:
        torch.testing.assert_close(torch.as_tensor(read.extra[name]), measured.extra[name])
    assert len(with_contacts(hand, obj, measured[:0])) == 0


def test_bare_clouds_are_refused(hand):
    cloud = load_object(np.random.default_rng(0).normal(size=(64, 3)) * 0.02)
    with pytest.raises(ObjectError, match="point cloud"):
        measure_contacts(hand, cloud, open_hand(hand, cloud, 0.1))
