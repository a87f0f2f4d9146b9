"""Forces of closed hands: contacts and torques as MuJoCo states them, programs as CVXPY solves them, a ball in a pinch."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import cvxpy
import mujoco
import numpy as np
import pytest
import torch
from scipy.optimize import nnls

from dro_grasp.geometry.contact_forces import GRAVITY, friction_cone
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import complete
from dro_grasp.hands.effort import find_efforts
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel, with_mass
from dro_grasp.simulation import payload as module
from dro_grasp.simulation.forces import find_forces, largest_payload
from dro_grasp.simulation.grasp_state import WeightConfig, grasp_state, press
from dro_grasp.simulation.payload import PayloadConfig, Squeezes, generators, given_way, payloads, servo_torques
from dro_grasp.simulation.pressure import Pressing
from dro_grasp.simulation.protocols import PROTOCOLS
from dro_grasp.simulation.rollout import RAMP
from dro_grasp.simulation.scene import scene_of
from tests.helpers.claw import power_grasp

AXES = [*np.eye(3), *-np.eye(3)]


def pinched(hand: Hand, force: float, lever: float = 0.05) -> Squeezes:
    """Two fingers that press on opposite sides of a ball of 3 cm by one joint each, which acts at a lever [m]."""
    normal = torch.tensor([[[1.0, 0, 0], [-1.0, 0, 0]]])
    jacobian = torch.zeros(1, 2, 3, hand.tree.n_dof)
    jacobian[0, 0, 0, 0], jacobian[0, 1, 0, 1] = lever, -lever
    touch = Pressing(normal, -0.03 * normal, torch.ones(1, 2), torch.tensor([[0, 1]]), torch.full((1, 2), force), jacobian,
                     torch.zeros_like(jacobian))
    joints = torch.full((1, hand.tree.n_dof), 0.1)
    base = joints.clone()
    base[0, :2] += force * lever / 3.0
    return Squeezes(hand, joints, base, torch.zeros_like(joints), torch.zeros(1, 2), touch, 3.0)


@pytest.mark.parametrize(("force", "friction"), [(4.0, 0.2), (8.0, 0.2), (8.0, 0.1)])
def test_two_fingers_hold_by_friction_what_they_press(hand: Hand, force: float, friction: float) -> None:
    # Once it slips, the object spreads the fingers as slopes would; so it may move little here.
    give = 1.5 * friction * force * 0.05**2 / 3.0
    config = PayloadConfig(friction=friction, torsion=0.02, masses=60, iterations=6000, remainder=3.0, edges=32, give=give,
                           softness=1e-6)
    found = float(payloads(pinched(hand, force), torch.zeros(1), torch.zeros(1), config))
    assert found == pytest.approx(2 * friction * force / GRAVITY, rel=1.5 * friction**2 + 0.04)


def test_who_touches_nothing_carries_nothing(hand: Hand) -> None:
    chosen = pinched(hand, 5.0)
    none = replace(chosen, contacts=replace(chosen.contacts, on=torch.zeros(1, 2)))
    one = replace(chosen, contacts=replace(chosen.contacts, on=torch.tensor([[1.0, 0.0]])))
    for alone in (none, one):
        assert float(payloads(alone, torch.zeros(1), torch.zeros(1))) == 0
    held, moved = (float(payloads(chosen, torch.tensor([shift]), torch.zeros(1))) for shift in (0.0, 0.019))
    assert 0 < moved < held


@pytest.mark.parametrize("friction", [0.2, 0.4])
def test_no_forces_hold_more_than_efforts_allow_two_fingers(friction: float) -> None:
    inward, lever, effort = torch.tensor([[1.0, 0, 0], [-1.0, 0, 0]]), 0.05, 0.3
    force = friction_cone(inward, friction, 8).double().flatten(0, 1).numpy()
    point = np.repeat(-0.03 * inward.numpy(), 8, 0)
    wrench = np.concatenate([force, np.cross(point, force)], 1).T
    torque = lever * np.stack([np.where(force[:, 0] > 0, force[:, 0], 0), np.where(force[:, 0] < 0, -force[:, 0], 0)])
    found = largest_payload(wrench, torque, np.full(2, effort))
    assert found == pytest.approx(2 * friction * (effort / lever) / GRAVITY, rel=1e-6)
    assert largest_payload(wrench[:, :8], torque[:, :8], np.full(2, effort)) == 0, "one finger holds nothing"
    assert largest_payload(wrench[:, :0], torque[:, :0], np.full(2, effort)) == 0


def test_the_linear_program_is_that_of_cvxpy() -> None:
    generator = np.random.default_rng(0)
    for _ in range(3):
        inward = np.array(AXES) + 0.2 * generator.normal(size=(6, 3))
        inward /= np.linalg.norm(inward, axis=1, keepdims=True)
        force = friction_cone(torch.from_numpy(inward), 0.5, 6).flatten(0, 1).numpy()
        wrench = np.concatenate([force, np.cross(np.repeat(-inward * [1.0, 0.8, 1.2], 6, 0), force)], 1).T
        torque, effort = 0.1 * np.abs(generator.normal(size=(4, 36))), np.array([0.5, 1.0, 0.2, 2.0])
        mass, problems = cvxpy.Variable(), []
        for axis in AXES:
            amounts = cvxpy.Variable(36, nonneg=True)
            weight = np.concatenate([axis, np.zeros(3)]) * GRAVITY
            problems += [wrench @ amounts + mass * weight == 0, cvxpy.abs(torque @ amounts) <= effort]
        cvxpy.Problem(cvxpy.Maximize(mass), problems).solve(solver=cvxpy.CLARABEL)
        assert mass.value > 0.01
        assert largest_payload(wrench, torque, effort) == pytest.approx(float(mass.value), rel=1e-4)


def test_what_gives_way_is_what_cvxpy_says(hand: Hand) -> None:
    config = PayloadConfig(iterations=4000)
    chosen = pinched(hand, 5.0)
    chosen = replace(chosen, contacts=replace(chosen.contacts, arm=chosen.contacts.arm + torch.tensor([0, 0.004, 0.002])))
    masses = torch.tensor([0.1, 0.7])
    moved, turned = given_way(chosen, masses, config)
    wrench, torque, _ = (x[0].double().numpy() for x in generators(chosen.contacts, config))
    spring = servo_torques(hand, chosen.joints, chosen.base, PROTOCOLS["carry"])[0].double().numpy()
    for i, mass in enumerate(masses.tolist()):
        for k, axis in enumerate(AXES):
            amounts = cvxpy.Variable(wrench.shape[1], nonneg=True)
            left = wrench @ amounts + np.concatenate([axis, np.zeros(3)]) * mass * GRAVITY
            per_contact = [wrench[:3, j:j + 8] @ amounts[j:j + 8] for j in (0, 8)]
            energy = (cvxpy.sum_squares(torque @ amounts - spring) / 3.0 + cvxpy.sum_squares(left) / config.remainder
                      + config.softness * sum(cvxpy.sum_squares(f) for f in per_contact))
            cvxpy.Problem(cvxpy.Minimize(energy)).solve(solver=cvxpy.CLARABEL)
            shift, turn = left.value[:3] / config.remainder, left.value[3:] / config.remainder / module.LEVER
            assert float(moved[0, i, k]) == pytest.approx(np.linalg.norm(shift), rel=0.03, abs=2e-4)
            assert float(turned[0, i, k]) == pytest.approx(np.linalg.norm(turn), rel=0.03, abs=5e-3)


def light_grasp(hand: Hand, obj: ObjectModel) -> GraspBatch:
    """A power grasp that presses with a third of the controller's squeeze, so that no servo is at its effort."""
    grasps = complete(hand, power_grasp(hand, obj, 1), torch.zeros(3))
    return grasps.replace(squeeze_joints=grasps.joints + 0.3 * (grasps.squeeze_joints - grasps.joints))


def closed_plainly(hand: Hand, obj: ObjectModel, protocol: str) -> Iterator[tuple[float, np.ndarray]]:
    """Sum of the normal forces on the object, and torques of the servos, after each half of the closing of one grasp."""
    grasps, rules = light_grasp(hand, obj), PROTOCOLS[protocol]
    scene = scene_of(hand, obj, grasps, protocol)
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[:] = scene.qpos(grasps.T_object_wrist, grasps.pregrasp_joints)[0]
    postures = [q[0].numpy()[scene.actuated] for q in (grasps.pregrasp_joints, grasps.joints, grasps.squeeze_joints)]
    data.ctrl[:] = postures[0]
    for begin, end in pairwise(postures):
        for i in range(RAMP):
            data.ctrl[:] = begin + (i + 1) / RAMP * (end - begin)
            for _ in range(round(rules.closing_time / model.opt.timestep) // RAMP):
                mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        total, force = 0.0, np.zeros(6)
        for k in range(data.ncon):
            if scene.object_body in model.geom_bodyid[data.contact.geom[k]]:
                mujoco.mj_contactForce(model, data, k, force)
                total += force[0]
        torque = np.zeros(hand.tree.n_dof)
        torque[scene.actuated] = data.actuator_force
        speed = np.array([data.qvel[model.joint(f"hand/{n}").dofadr[0]] for n in hand.tree.joint_names])
        yield total, torque + rules.damping * speed


@pytest.mark.parametrize("protocol", ["carry", "dexgraspbench"])  # whose servos are stiffer
def test_forces_are_those_that_mujoco_states(hand: Hand, obj: ObjectModel, protocol: str) -> None:
    found = find_forces(hand, obj, light_grasp(hand, obj), protocol)
    halves = list(closed_plainly(hand, obj, protocol))
    for (total, torque), contacts, torques in zip(halves, (found.grasp_contacts, found.squeeze_contacts),
                                                  (found.grasp_torque, found.squeeze_torque), strict=True):
        assert float(contacts[0].pressure.sum()) == pytest.approx(total, rel=1e-3, abs=1e-3)
        np.testing.assert_allclose(torques[0].numpy(), torque, atol=2e-3)
    assert halves[1][0] > 1
    assert float(found.squeeze_force) == pytest.approx(halves[1][0], rel=1e-3)
    assert float(found.squeeze_torque.abs().max()) > 0.02
    assert float(found.largest_payload) > 0


def test_forces_of_no_grasps_are_none(hand: Hand, obj: ObjectModel) -> None:
    found = find_forces(hand, obj, power_grasp(hand, obj, 1)[:0])
    assert found.payload.shape == found.squeeze_force.shape == (0,)
    assert found.squeeze_torque.shape == (0, hand.tree.n_dof)


def test_the_weighed_payload_is_where_trials_begin_to_fail(hand: Hand, obj: ObjectModel) -> None:
    grasps = light_grasp(hand, obj)
    found = float(find_forces(hand, obj, grasps, weigh=True).payload)

    def gave(mass: float) -> float:
        state, _ = grasp_state(hand, with_mass(obj, mass), grasps, "carry")
        return float(state.gave[0, 0])

    assert gave(0.4 * found) < 0.02 < gave(2.5 * found)


@pytest.mark.parametrize("limit", [1.0, 2.0])
def test_no_link_presses_harder_than_it_may(hand: Hand, obj: ObjectModel, limit: float) -> None:
    heavy, grasps = with_mass(obj, 0.3), light_grasp(hand, obj)
    freely, gently = (
        press(hand, heavy, grasps, "carry", config=WeightConfig(max_force=most)) for most in (math.inf, limit))
    found = [find_forces(hand, heavy, pressed) for pressed in (freely, gently)]
    hardest = [forces.squeeze_contacts[0].hardest_link for forces in found]
    assert hardest[1] <= 1.15 * limit < hardest[0]
    assert float(found[1].squeeze_force) < float(found[0].squeeze_force)
    assert float(gently.payload) <= float(freely.payload)


def test_squeezes_stay_within_efforts(hand: Hand, obj: ObjectModel) -> None:
    chosen = replace(pinched(hand, 1.0), torques=torch.full((1, hand.tree.n_dof), 0.5))
    targets = chosen.targets(torch.tensor([[0.01, 100.0]]))
    wanted = (targets - chosen.joints) * 3.0
    limit = find_efforts(hand).limit
    assert (wanted.abs() <= limit + 1e-5).all()
    assert (wanted[0, 0] < wanted[0, 1] + 1e-6).all()
    added = (wanted[0, 1] - (chosen.base - chosen.joints)[0] * 3.0) / chosen.torques[0]
    free = targets[0, 1] < hand.tree.upper - 1e-6
    assert math.isclose(float(added[free].min()), float(added[free].max()), rel_tol=1e-3), "all torques shrink alike"


def test_large_programs_are_solved_with_any_number_of_threads() -> None:
    """Twenty contacts have 160 unknowns, for which some batched LU fails with two threads. SciPy says the answer."""
    generator = torch.Generator().manual_seed(0)
    factor = torch.randn(6, 160, 160, generator=generator) / 160**0.5
    hessian = factor @ factor.mT + torch.eye(160)
    slope = torch.randn(6, 160, 2, generator=generator)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        found = module._least_energy(hessian, slope, PayloadConfig(iterations=400))
    finally:
        torch.set_num_threads(threads)
    for k, c in ((0, 0), (5, 1)):
        root = np.linalg.cholesky(hessian[k].double().numpy())
        expected, _ = nnls(root.T, np.linalg.solve(root, slope[k, :, c].double().numpy()))
        np.testing.assert_allclose(found[k, :, c], expected, atol=2e-3)
