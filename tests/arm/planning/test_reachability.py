"""Inverse kinematics, arms with five joints, and hopeless grasps. Oracles: forward kinematics, the plane of the links."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from scipy.spatial.transform import Rotation

import dro_grasp as dro
from dro_grasp.arm.planning.reachability import (
    STEEPEST,
    TURNED,
    Fault,
    Reachability,
    ReachConfig,
    WristSolver,
    lowest_points,
    reachable_directions,
)
from dro_grasp.arm.planning.workcell import Workcell
from dro_grasp.arm.robots.loading import load_robot
from dro_grasp.arm.robots.robot import Robot
from dro_grasp.optimize.grasp_energy import PRESSED
from tests.helpers.claw_urdf import PALM, joint, link

TURNS = '<limit lower="-2.4" upper="2.4" effort="5" velocity="2"/>'


JOINTS = ("pan", "shoulder", "elbow", "pitch", "roll")


@pytest.fixture(scope="module")
def five(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    """An arm that turns about the vertical, bends in one plane, and rolls its claw."""
    folder = tmp_path_factory.mktemp("arm")
    names = ("base", "turret", "upper", "lower", "wrist", "palm")
    places = ("0 0 0.05", "0 0 0.05", "0 0 0.2", "0 0 0.2", "0 0 0.05")
    axes = ("0 0 1", "0 1 0", "0 1 0", "0 1 0", "0 0 1")
    parts = [joint(name, above, below, at, axis, TURNS)
             for name, above, below, at, axis in zip(JOINTS, names[:-1], names[1:], places, axes, strict=True)]
    parts += [joint("a", "palm", "left", "-0.035 0 0.01"), joint("b", "palm", "right", "0.035 0 0.01", "0 -1 0")]
    links = PALM + "".join(link(name) for name in (*names[:-1], "left", "right"))
    (folder / "arm.urdf").write_text(f'<robot name="arm">{links}{"".join(parts)}</robot>')
    values = {"arm": "arm.urdf", "hand": "arm.urdf#palm", "home": dict.fromkeys(JOINTS, 0.1),
              "limits": {"velocity": 1.0, "acceleration": 4.0}, "hand_limits": {"velocity": 1.0, "acceleration": 4.0}}
    (folder / "robot.yaml").write_text(yaml.safe_dump(values))
    return load_robot(folder / "robot.yaml")


def test_palms_face_in_the_plane_of_the_links_and_not_up(five: Robot) -> None:
    place = np.array([0.3, 0.12, 0.06])
    found = reachable_directions(five, place).double().numpy()
    across = np.cross([0, 0, 1], place / np.linalg.norm(place[:2]))
    assert five.has_few_joints
    assert np.allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    assert np.abs(found @ across).max() < 0.2
    assert found[:, 2].max() < STEEPEST
    assert np.ptp(np.arctan2(found[:, 2], found @ (place / np.linalg.norm(place)))) > 0.8


def test_the_grasp_centre_is_where_it_was_asked_for_and_the_wrist_turned_a_little(five: Robot) -> None:
    solver, (lower, upper) = WristSolver(Workcell(five)), five.working_range
    q = np.array([0.4, 0.9, 0.8, 0.7, 0.3])
    T, seeds = five.T_world_wrist(q), [q + 0.1, five.home]
    centre = five.hand.grasp_centre_wrist.double().numpy()
    place = T[:3, :3] @ centre + T[:3, 3]
    out_of_plane = np.cross([0, 0, 1], place / np.linalg.norm(place[:2]))
    about = np.cross(out_of_plane, T[:3, :3] @ five.hand.palm_direction_wrist.double().numpy())
    for angle, reached in ((0.0, True), (0.6 * TURNED, True), (3 * TURNED, False)):
        asked = np.eye(4)
        asked[:3, :3] = Rotation.from_rotvec(angle * about / np.linalg.norm(about)).as_matrix() @ T[:3, :3]
        asked[:3, 3] = place - asked[:3, :3] @ centre
        found = solver.solve(asked, seeds)
        assert (found is not None) == reached
        if found is not None:
            made = five.T_world_wrist(found)
            assert np.abs(made[:3, :3] @ centre + made[:3, 3] - place).max() < 1e-3
            assert Rotation.from_matrix(made[:3, :3].T @ asked[:3, :3]).magnitude() < TURNED
            assert ((found >= lower) & (found <= upper)).all()


def test_a_small_arm_approaches_and_lifts_less(five: Robot) -> None:
    config = ReachConfig().within(five)
    assert five.longest_reach < 0.7
    assert (config.standoff, config.lift) == (0.05, 0.08)
    assert ReachConfig(lift=0.03).within(five).lift == 0.03
    assert ReachConfig().within(load_robot("xarm7_leaphand")) == ReachConfig()


def test_inverse_kinematics_reaches_what_forward_kinematics_reached_and_nothing_beyond(robot: dro.Robot) -> None:
    solver, (lower, upper) = WristSolver(Workcell(robot)), robot.working_range
    generator = np.random.default_rng(3)
    seeds = [robot.home, *generator.uniform(lower, upper, (8, 7))]
    wanted = robot.T_world_wrist(generator.uniform(lower, upper, (10, 7)))
    found = [solver.solve(T, seeds) for T in wanted]
    assert sum(q is not None for q in found) >= 8
    for q, T in zip(found, wanted, strict=True):
        if q is not None:
            assert np.abs(robot.T_world_wrist(q) - T)[:3, 3].max() < 1e-3
            assert ((q >= lower) & (q <= upper)).all()
    far = np.eye(4)
    far[0, 3] = robot.longest_reach
    assert solver.solve(far, seeds[:2]) is None


def test_hands_that_would_meet_an_obstacle_are_dropped(robot: dro.Robot) -> None:
    obj, T = dro.load_object("can"), np.eye(4)
    T[:3, 3] = 0.5, 0.1, -float(obj.cloud[:, 2].min())
    hand = robot.hand
    wrist = torch.eye(4)[None].repeat(2, 1, 1)
    wrist[:, :3, 3] = torch.tensor([[0.5, 0.1, 0.4], [0.5, 0.6, 0.4]])
    opened = torch.from_numpy(robot.open_hand).float()[None].repeat(2, 1)
    grasps = dro.GraspBatch.create(hand, obj, wrist, opened).replace(pregrasp_joints=opened, squeeze_joints=opened)
    middle = hand.points(opened[0], wrist[0]).mean(0).numpy()
    ball = np.random.default_rng(0).normal(size=(500, 3))
    obstacle = dro.load_object(middle + 0.03 * ball / np.linalg.norm(ball, axis=1, keepdims=True), keep_table=True)
    for thing in (obstacle, dro.load_object("cube")):
        reach = Reachability(Workcell(replace(robot, table=None), [thing], obj, T), ReachConfig(), 0)
        assert reach.hopeless(grasps) == ({0: Fault.HITS_OBSTACLE} if thing is obstacle else {})


def test_where_a_squeeze_aims_counts_as_higher(robot: dro.Robot) -> None:
    """Since the table stops it; of the same hand in grasp or pregrasp each millimetre counts."""
    assert robot.table is not None
    hand, wrist = robot.hand, torch.eye(4)[None].clone()
    high, low = (hand.canonical_joints(share)[None] for share in (0.0, 1.0))
    wrist[:, :3, 3] = torch.tensor([0.5, 0.0, 0.3])
    lowest = {q: float(hand.points(q, wrist)[..., 2].min()) for q in (high, low)}
    assert lowest[low] + PRESSED < lowest[high]
    grasps = dro.GraspBatch.create(hand, dro.load_object("can"), wrist, high).replace(
        pregrasp_joints=high, squeeze_joints=high)
    for given, height in (({}, lowest[high]), ({"joints": low}, lowest[low]), ({"pregrasp_joints": low}, lowest[low]),
                          ({"squeeze_joints": low}, lowest[low] + PRESSED)):
        assert float(lowest_points(hand, grasps.replace(**given), robot.table)) == pytest.approx(height, abs=1e-6)
