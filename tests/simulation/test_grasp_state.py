"""What holds an object after closing: motion and contacts as trials have them, answers to pushes as SciPy finds them."""

from __future__ import annotations

import math

import cvxpy
import numpy as np
import pytest
import torch
from scipy.optimize import nnls

from dro_grasp.geometry.contact_forces import LEVER
from dro_grasp.grasps.controller import complete
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation import grasp_state as module
from dro_grasp.simulation.grasp_state import (
    CHANGE,
    NO_ANSWER,
    PUSH,
    ContactForces,
    WeightConfig,
    grasp_state,
    press,
    pressed_many,
    squeezes_of,
    unanswered,
)
from dro_grasp.simulation.protocols import CARRY
from dro_grasp.simulation.rollout import Pulls, rollouts
from dro_grasp.simulation.scene import scene_of
from dro_grasp.simulation.trial import simulate
from tests.helpers.claw import power_grasp

MASS = torch.tensor([0.1])


def pinch(pressure: float, points: int = 2) -> ContactForces:
    """Contacts on opposite sides of a ball of 3 cm."""
    x = np.array([[1.0, 0, 0], [-1.0, 0, 0]])[:points]
    return ContactForces(-x, 0.03 * x, 0.03 * x, np.arange(points), np.full(points, pressure), np.zeros(points))


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


@pytest.mark.parametrize("name", ["carry", "strict"])
def test_motion_and_contacts_are_those_of_a_trial(hand: Hand, obj: ObjectModel, name: str) -> None:
    grasps = power_grasp(hand, obj, 2)
    T = grasps.T_object_wrist.clone()
    T[1, 2, 3] -= 0.01
    grasps = grasps.replace(T_object_wrist=T)
    (found, _), trial = grasp_state(hand, obj, grasps, name), simulate(hand, obj, grasps, name)
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
    found, _ = grasp_state(hand, obj, away)
    assert found.contacts.tolist() == found.links.tolist() == found.pressure.tolist() == [0.0]
    assert found.unanswered.tolist() == [[NO_ANSWER, NO_ANSWER]]
    assert float(found.shift) == float(found.speed) == 0.0


def test_a_firmer_squeeze_presses_harder(hand: Hand, obj: ObjectModel) -> None:
    grasps = complete(hand, power_grasp(hand, obj, 1), torch.as_tensor(obj.centre_of_mass))
    firmer = grasps.replace(squeeze_joints=2 * grasps.squeeze_joints - grasps.joints)
    assert 1.5 * grasp_state(hand, obj, grasps)[0].pressure < grasp_state(hand, obj, firmer)[0].pressure


def test_no_grasps_hold_nothing(hand: Hand, obj: ObjectModel) -> None:
    found, _ = grasp_state(hand, obj, power_grasp(hand, obj, 1)[:0])
    assert found.shift.shape == (0,)
    assert found.unanswered.shape == (0, 2)


def held_by(links: np.ndarray, points: np.ndarray, centre: np.ndarray) -> ContactForces:
    """Contacts at points of links that press towards a centre."""
    arm = points - centre
    inward = -arm / np.linalg.norm(arm, axis=1, keepdims=True)
    return ContactForces(inward, arm, points, links, np.arange(len(points), 0, -1.0), np.zeros(len(points)))


def least_forces(c: ContactForces, weight: float, friction: float, edges: int) -> np.ndarray:
    """Mean of the least forces at the contacts that balance a weight along six axes, by CVXPY."""
    found = []
    for axis in [*np.eye(3), *-np.eye(3)]:
        forces, amounts = [], []
        for n in c.normal:
            side = np.cross(n, np.eye(3)[np.abs(n).argmin()])
            side /= np.linalg.norm(side)
            angles = np.arange(edges) * 2 * math.pi / edges
            cone = n + friction * (np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * np.cross(n, side))
            amounts.append(cvxpy.Variable(edges, nonneg=True))
            forces.append(cone.T @ amounts[-1])
        torque = sum(np.cross(np.eye(3), r).T @ f for r, f in zip(c.arm, forces, strict=True))
        missing = cvxpy.sum_squares(sum(forces) + axis) + cvxpy.sum_squares(torque / LEVER)
        least = cvxpy.Minimize(missing + module.SMALLEST * cvxpy.sum_squares(cvxpy.hstack(amounts)))
        cvxpy.Problem(least).solve(solver=cvxpy.CLARABEL)
        found.append(np.stack([f.value for f in forces]))
    return weight * np.mean(found, 0)


def test_torques_that_hold_the_weight_are_those_of_the_least_forces(hand: Hand) -> None:
    joints = 0.4 * torch.ones(1, hand.tree.n_dof)
    tips = np.array(hand.tips)
    points = (hand.tree.forward(joints)[0, tips, :3, 3] + torch.tensor([0.0, 0.0, 0.03])).double().numpy()
    contacts = held_by(tips, points, points.mean(0) + np.array([0.004, 0.002, -0.003]))
    config = WeightConfig(margin=1.5, iterations=2000)
    found = 0.2 * squeezes_of(hand, [contacts], joints, joints, config).torques[0]
    forces = least_forces(contacts, 1.5 * 9.81 * 0.2, config.friction, config.edges)
    jacobian = hand.tree.point_jacobian(
        hand.tree.forward(joints)[0], torch.from_numpy(points).float(), torch.from_numpy(tips)).double().numpy()
    expected = np.einsum("kc,kcd->d", forces, jacobian)
    assert np.abs(expected).max() > 0.01
    np.testing.assert_allclose(found.numpy(), expected, atol=0.02 * np.abs(expected).max())


def test_nothing_presses_for_a_weight_without_margin_or_contacts(hand: Hand) -> None:
    joints = torch.zeros(1, hand.tree.n_dof)
    nothing = held_by(np.zeros(0, int), np.zeros((0, 3)), np.zeros(3))
    assert not squeezes_of(hand, [nothing], joints, joints, WeightConfig()).torques.any()
    tips = np.array(hand.tips)
    some = held_by(tips, np.eye(4)[:, :3] * 0.03 + 0.05, np.zeros(3))
    assert not squeezes_of(hand, [some], joints, joints, WeightConfig(margin=0.0)).torques.any()


def test_payloads_of_some_rows_are_those_of_all(hand: Hand, obj: ObjectModel, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dro_grasp.simulation.rollout.CHUNK", 2)  # the rows are of several parts
    grasps, rows = power_grasp(hand, obj, 3), torch.tensor([True, False, True])
    T = grasps.T_object_wrist.clone()
    T[:, 2, 3] -= torch.tensor([0.0, 0.003, 0.006])
    grasps = grasps.replace(T_object_wrist=T)
    every, done = press(hand, obj, grasps, "carry"), pressed_many(hand, [obj], [grasps], "carry")
    found = done.payloads(rows)
    assert torch.equal(found.isnan(), ~rows)
    torch.testing.assert_close(found[rows], every.payload[rows])
    assert float(every.payload[0]) > 0
    assert float((every.payload[0] - every.payload[2]).abs()) > 1e-4, "a wrong order of rows shows"
    torch.testing.assert_close(done.grasps.squeeze_joints, every.squeeze_joints)


def test_pulls_end_for_what_gives_way_and_stay_the_same_for_what_holds(hand: Hand, obj: ObjectModel) -> None:
    grasps = complete(hand, power_grasp(hand, obj, 2), torch.as_tensor(obj.centre_of_mass))
    loose = grasps.squeeze_joints.clone()
    loose[1] = grasps.pregrasp_joints[1]
    grasps = grasps.replace(squeeze_joints=loose)
    found = []
    for farthest in (CARRY.max_displacement, math.inf):
        (_, rollout), = rollouts(scene_of(hand, obj, grasps, CARRY), hand, grasps, workers=1)
        pulls = Pulls(9.81, 0.2, reset=True, from_start=True, farthest=farthest)
        found.append(rollout.push(rollout.close(), np.ones(2, bool), pulls)[0])
    (ends, goes_on), limit = found, CARRY.max_displacement
    assert ends[0].max() < limit < ends[1].max()
    np.testing.assert_array_equal(ends[0], goes_on[0])
    first = int((goes_on[1] >= limit).argmax())
    np.testing.assert_array_equal(ends[1, :first + 1], goes_on[1, :first + 1])
    assert (ends[1, first:] == ends[1, first]).all(), "later columns keep the value at which it ended"
    assert not np.array_equal(ends[1], goes_on[1])
