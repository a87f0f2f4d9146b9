"""What holds an object after closing: motion and contacts as trials have them, answers to pushes as SciPy finds them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.optimize import nnls

from dro_grasp.grasps.controller import complete
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation import grasp_state as module
from dro_grasp.simulation.grasp_state import CHANGE, LEVER, NO_ANSWER, PUSH, ContactForces, grasp_state, unanswered
from dro_grasp.simulation.trial import simulate
from tests.helpers.claw import ball, claw, power_grasp

MASS = torch.tensor([0.1])


@pytest.fixture(scope="module")
def hand(tmp_path_factory: pytest.TempPathFactory) -> Hand:
    return claw(tmp_path_factory.mktemp("hand"))


@pytest.fixture(scope="module")
def obj() -> ObjectModel:
    return ball()


def pinch(pressure: float, points: int = 2) -> ContactForces:
    """Contacts on opposite sides of a ball of 3 cm."""
    x = np.array([[1.0, 0, 0], [-1.0, 0, 0]])[:points]
    return ContactForces(-x, 0.03 * x, np.full(points, pressure), np.zeros(points), points)


def plain(c: ContactForces, mass: float, friction: float) -> list[float]:
    """What stays unanswered of each push, by SciPy, contact by contact."""
    found = []
    for axis in [*np.eye(3), *-np.eye(3)]:
        columns = []
        for k, (n, r, p) in enumerate(zip(c.normal, c.arm, c.pressure, strict=True)):
            side = np.cross(n, np.eye(3)[np.abs(n).argmin()])
            side /= np.linalg.norm(side)
            for angle in np.arange(6) * math.pi / 3:
                f = n + friction * (math.cos(angle) * side + math.sin(angle) * np.cross(n, side))
                same = CHANGE * (np.arange(len(c.pressure)) == k)
                columns.append(np.concatenate([p / (10 * mass) * np.concatenate([f, np.cross(r / LEVER, f)]), same]))
        goal = np.concatenate([-axis * PUSH / 10, np.zeros(3), np.full(len(c.pressure), CHANGE)])
        found.append(nnls(np.array(columns).T, goal)[1])
    return found


@pytest.mark.parametrize("pressure", [0.05, 0.5, 5.0])
@pytest.mark.parametrize("points", [1, 2])
def test_answers_are_those_of_a_plain_least_squares(pressure: float, points: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "STEPS", 2000)
    monkeypatch.setattr(module, "RIDGE", 1e-7)
    contacts = pinch(pressure, points)
    found, expected = unanswered([contacts], MASS, 0.4)[0], plain(contacts, 0.1, 0.4)
    assert float(found[0]) == pytest.approx(min(max(expected), NO_ANSWER), abs=0.02)
    assert float(found[1]) == pytest.approx(np.mean(np.minimum(expected, NO_ANSWER)), abs=0.02)


def test_a_firm_pinch_answers_what_a_loose_one_and_one_finger_cannot() -> None:
    firm, loose, alone, none = unanswered(
        [pinch(10.0), pinch(0.1), pinch(10.0, 1), pinch(1.0, 0)], MASS.expand(4), 0.5)[:, 0].tolist()
    assert firm < 0.3 < loose < alone
    assert none == NO_ANSWER


def test_motion_and_contacts_are_those_of_a_trial(hand: Hand, obj: ObjectModel) -> None:
    grasps = power_grasp(hand, obj, 2)
    T = grasps.T_object_wrist.clone()
    T[1, 2, 3] -= 0.01
    grasps = grasps.replace(T_object_wrist=T)
    found, trial = grasp_state(hand, obj, grasps), simulate(hand, obj, grasps, "strict")
    torch.testing.assert_close(found.shift, trial.closing_shift)
    torch.testing.assert_close(found.turn, trial.closing_rotation)
    assert found.links.tolist() == [len(links) for links in trial.contact_links]
    assert (found.contacts >= found.links).all()
    assert (found.pressure > 0.1).all()


def test_an_open_hand_holds_nothing(hand: Hand, obj: ObjectModel) -> None:
    grasps = power_grasp(hand, obj, 1)
    opened = torch.zeros_like(grasps.joints)
    far = grasps.T_object_wrist.clone()
    far[:, 2, 3] -= 0.5
    away = grasps.replace(T_object_wrist=far, joints=opened, pregrasp_joints=opened, squeeze_joints=opened)
    found = grasp_state(hand, obj, away)
    assert found.contacts.tolist() == found.links.tolist() == found.pressure.tolist() == [0.0]
    assert found.unanswered.tolist() == [[NO_ANSWER, NO_ANSWER]]
    assert float(found.shift) == float(found.speed) == 0.0


def test_a_firmer_squeeze_presses_harder(hand: Hand, obj: ObjectModel) -> None:
    grasps = complete(hand, power_grasp(hand, obj, 1), torch.as_tensor(obj.centre_of_mass))
    firmer = grasps.replace(squeeze_joints=2 * grasps.squeeze_joints - grasps.joints)
    assert 1.5 * grasp_state(hand, obj, grasps).pressure < grasp_state(hand, obj, firmer).pressure


def test_no_grasps_hold_nothing(hand: Hand, obj: ObjectModel) -> None:
    found = grasp_state(hand, obj, power_grasp(hand, obj, 1)[:0])
    assert found.shift.shape == (0,)
    assert found.unanswered.shape == (0, 2)
