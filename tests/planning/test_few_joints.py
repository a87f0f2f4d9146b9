"""Arms with five joints, which bring the wrist to few poses. Oracle: the plane of the links, and forward kinematics."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from dro_grasp.planning.few_joints import STEEPEST, TURNED, has_few_joints, reachable_directions
from dro_grasp.planning.inverse_kinematics import WristSolver
from dro_grasp.planning.reachability import ReachConfig
from dro_grasp.planning.robot import Robot, load_robot
from tests.helpers.claw_urdf import PALM, joint, link

TURNS = '<limit lower="-2.4" upper="2.4" effort="5" velocity="2"/>'
JOINTS = ("pan", "shoulder", "elbow", "pitch", "roll")


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
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


def test_palms_face_in_the_plane_of_the_links_and_not_up(robot: Robot) -> None:
    place = np.array([0.3, 0.12, 0.06])
    found = reachable_directions(robot, place).double().numpy()
    across = np.cross([0, 0, 1], place / np.linalg.norm(place[:2]))
    assert has_few_joints(robot)
    assert np.allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    assert np.abs(found @ across).max() < 0.2
    assert found[:, 2].max() < STEEPEST
    assert np.ptp(np.arctan2(found[:, 2], found @ (place / np.linalg.norm(place)))) > 0.8


def test_the_grasp_centre_is_where_it_was_asked_for_and_the_wrist_turned_a_little(robot: Robot) -> None:
    solver, (lower, upper) = WristSolver(robot), robot.working_range
    q = np.array([0.4, 0.9, 0.8, 0.7, 0.3])
    T, seeds = robot.T_world_wrist(q), [q + 0.1, robot.home]
    centre = robot.hand.grasp_centre_wrist.double().numpy()
    place = T[:3, :3] @ centre + T[:3, 3]
    out_of_plane = np.cross([0, 0, 1], place / np.linalg.norm(place[:2]))
    about = np.cross(out_of_plane, T[:3, :3] @ robot.hand.palm_direction_wrist.double().numpy())
    for angle, reached in ((0.0, True), (0.6 * TURNED, True), (3 * TURNED, False)):
        asked = np.eye(4)
        asked[:3, :3] = Rotation.from_rotvec(angle * about / np.linalg.norm(about)).as_matrix() @ T[:3, :3]
        asked[:3, 3] = place - asked[:3, :3] @ centre
        found = solver.solve(asked, seeds)
        assert (found is not None) == reached
        if found is not None:
            made = robot.T_world_wrist(found)
            assert np.abs(made[:3, :3] @ centre + made[:3, 3] - place).max() < 1e-3
            assert Rotation.from_matrix(made[:3, :3].T @ asked[:3, :3]).magnitude() < TURNED
            assert ((found >= lower) & (found <= upper)).all()


def test_a_small_arm_approaches_and_lifts_less(robot: Robot) -> None:
    config = ReachConfig().within(robot)
    assert robot.longest_reach < 0.7
    assert (config.standoff, config.lift) == (0.05, 0.08)
    assert ReachConfig(lift=0.03).within(robot).lift == 0.03
    assert ReachConfig().within(load_robot("xarm7_leaphand")) == ReachConfig()
