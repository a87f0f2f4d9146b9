"""Several things on a table: told apart, avoided, and refused in words where it is not clear which is wanted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dro_grasp as dro
from dro_grasp.arm.camera_view import depth_image, thinned_intrinsics
from dro_grasp.arm.physics import LiftScene
from dro_grasp.arm.table_scene import clusters, fit_plane, pick_object, sees_table, sort_out
from dro_grasp.arm.workcell import VOXEL, Workcell, moved, occupied
from dro_grasp.cli.main import main
from dro_grasp.objects.perception.scan import depth_points

CUBE, BALL, RADIUS = (0.45, 0.1), (0.5, -0.1), 0.04


@pytest.fixture(scope="module")
def table_cloud() -> np.ndarray:
    """A table at z = 0 with a cube and a ball on it, in the world."""
    random = np.random.default_rng(0)
    table = np.column_stack([random.uniform([0.1, -0.5], [0.8, 0.5], (20_000, 2)), random.normal(0, 0.001, 20_000)])
    cube = random.uniform(-0.03, 0.03, (3000, 3))
    rows = np.arange(len(cube))
    cube[rows, random.integers(3, size=len(cube))] = random.choice([-0.03, 0.03], len(cube))
    ball = random.normal(size=(3000, 3))
    ball *= RADIUS / np.linalg.norm(ball, axis=1, keepdims=True)
    return np.concatenate([table, cube + np.array([*CUBE, 0.03]), ball + np.array([*BALL, RADIUS])])


def test_the_thing_near_a_place_is_picked_and_the_other_is_an_obstacle(table_cloud: np.ndarray, robot: dro.Robot) -> None:
    picked = pick_object("cube", table_cloud, robot, near=(0.44, 0.13))
    assert np.allclose(picked.obj.cloud.mean(0)[:2], CUBE, atol=2e-3)
    assert np.allclose(np.ptp(picked.obj.cloud, axis=0), (0.06, 0.06, 0.054), atol=3e-3)
    (other,) = picked.obstacles
    assert np.allclose(np.ptp(other.cloud, axis=0)[:2], 2 * RADIUS, atol=2 * VOXEL)
    assert picked.robot.table is not None
    assert picked.robot.table.height == pytest.approx(0, abs=1e-3)
    below = np.linalg.norm(other.cloud - (*BALL, 0.02), axis=1).min()
    assert below < VOXEL  # only the ball's surface was given, but what is below its top is solid


def test_what_a_camera_saw_of_the_thing_is_known_in_the_world(table_cloud: np.ndarray, robot: dro.Robot) -> None:
    assert robot.camera is not None
    T = robot.camera.T_world_camera
    toward = np.linalg.inv(T)
    visible = table_cloud[(table_cloud[:, 2] > 0.0595) | (table_cloud[:, 2] < 1e-3)]  # a cube's top, a ball's, and the table
    obj = pick_object("cube", visible @ toward[:3, :3].T + toward[:3, 3], robot, T, near=CUBE).obj
    assert obj.seen is not None
    assert np.abs(obj.seen[:, 2] - 0.06).max() < 2e-3
    assert obj.cloud[:, 2].min() < 0.05
    turn = np.array([[0.0, -1, 0, 0.3], [1, 0, 0, 0], [0, 0, 1, 0.1], [0, 0, 0, 1]])
    there = moved(obj, turn)
    tilted = moved(replace(obj, table=np.array([0.0, 0.0, 1.0, 0.02])), turn[[2, 0, 1, 3]])
    assert tilted.table is not None
    assert np.allclose(tilted.table, (1, 0, 0, 0.02 + 0.1)), "its table turns with it"
    assert there.seen is not None
    x, y, z = obj.seen.T
    np.testing.assert_allclose(there.seen, np.column_stack([0.3 - y, x, z + 0.1]), atol=1e-6)


def test_a_mask_of_bytes_and_lists_are_taken_and_a_pose_that_is_none_is_refused(
    table_cloud: np.ndarray, robot: dro.Robot
) -> None:
    mask = 255 * (np.abs(table_cloud[:, :2] - CUBE).max(1) < 0.04).astype(np.uint8)
    wanted = pick_object("cube", table_cloud, robot, mask=mask > 0).obj
    assert np.allclose(wanted.cloud.mean(0)[:2], CUBE, atol=2e-3)
    assert pick_object("cube", table_cloud, robot, mask=mask).obj.sha256 == wanted.sha256
    assert pick_object("cube", table_cloud.tolist(), robot, mask=mask.tolist()).obj.sha256 == wanted.sha256
    with pytest.raises(dro.DroGraspError, match="one entry for each point"):
        pick_object("cube", table_cloud, robot, mask=mask[:-1])
    with pytest.raises(dro.DroGraspError, match="is not a rotation"):
        pick_object("cube", table_cloud, robot, np.diag([1.0, 1.0, -1.0, 1.0]), near=CUBE)


def test_a_speck_is_an_obstacle_too(table_cloud: np.ndarray, robot: dro.Robot) -> None:
    speck = np.array([0.304, 0.304, 0.014]) + 0.001 * np.eye(3).repeat(2, 0)
    picked = pick_object("cube", np.concatenate([table_cloud[:-3000], speck]), robot, near=CUBE)
    (other,) = picked.obstacles
    assert len(occupied(other.cloud.astype(float))[0]) == 1
    assert np.abs(other.cloud - speck.mean(0)).max() < 1.5 * VOXEL


def test_a_mask_tells_apart_what_touches(table_cloud: np.ndarray, robot: dro.Robot) -> None:
    cloud = table_cloud.copy()
    cloud[-3000:, 1] += 0.13
    cloud[-3000:, 0] -= 0.05
    mask = np.arange(len(cloud)) >= len(cloud) - 3000
    assert robot.table is not None
    assert len(sort_out(cloud, np.eye(4), robot.table).places) == 1
    sight = sort_out(cloud, np.eye(4), robot.table, mask=mask)
    assert np.abs(np.linalg.norm(sight.points - (0.45, 0.03, RADIUS), axis=1) - RADIUS).max() < 1e-6
    assert len(sight.others) == pytest.approx(2300, rel=0.1)  # less its lower side


def test_a_cloud_of_a_table_is_known_from_one_of_an_object(table_cloud: np.ndarray, robot: dro.Robot) -> None:
    assert robot.table is not None
    assert sees_table(table_cloud, robot.table)
    assert not sees_table(table_cloud[-6000:-3000], robot.table)


@pytest.mark.parametrize(("rows", "options", "said"), [
    (slice(None), [], "has 2 things that stand on the table, at"),
    (slice(0, 20_000), [], "nothing stands on the table"),
    (slice(0, 20_000), ["--near", "0.4", "0"], "nothing stands on the table"),
    (slice(None), ["--near", "0.4", "0", "--at", "0.4", "0"], "leave out --pose and --at"),
])
@pytest.mark.parametrize("frame", ["world", "camera"])
def test_a_cloud_of_which_it_is_not_clear_what_is_wanted_is_refused(
    rows: slice, options: list[str], said: str, frame: str, table_cloud: np.ndarray, robot: dro.Robot, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    cloud, output = table_cloud[rows], tmp_path / "plan.npz"
    if frame == "camera":
        assert robot.camera is not None
        T = np.linalg.inv(robot.camera.T_world_camera)
        cloud, options = cloud @ T[:3, :3].T + T[:3, 3], [*options, "--camera", "robot"]
        said = said if "--at" not in options else "give one of them"
    np.save(tmp_path / "cloud.npy", cloud)
    command = ["plan", "--robot", "xarm7_leaphand", "--object", str(tmp_path / "cloud.npy"), "--output", str(output)]
    assert main([*command, *options]) == 2
    assert said in capsys.readouterr().err
    assert not output.exists()


def test_a_plane_is_found_under_noise_and_clutter_and_a_wall_is_none() -> None:
    random = np.random.default_rng(0)
    flat = np.column_stack([random.uniform(-1, 1, (800, 2)), random.normal(0.1, 0.001, 800)])
    things = random.uniform([-0.2, -0.2, 0.12], [0.2, 0.2, 0.3], (300, 3))
    plane = fit_plane(np.concatenate([flat, things]))
    assert np.allclose(plane, [0, 0, 1, 0.1], atol=(5e-3, 5e-3, 5e-3, 1e-3))
    with pytest.raises(dro.DroGraspError, match="no level table"):
        fit_plane(flat[:, [2, 0, 1]])
    assert len(set(clusters(np.array([[0, 0, 0], [0, 0, 0.01], [0, 0, 0.1]], float)).tolist())) == 2


def test_an_empty_table_is_refused_in_words(robot: dro.Robot) -> None:
    scene = LiftScene(Workcell(robot), [dro.load_object("can")])
    aside = np.eye(4)
    aside[:3, 3] = 3.0, 3.0, 0.5
    scene.place(0, aside)
    assert robot.camera is not None
    assert robot.table is not None
    points = depth_points(depth_image(scene, robot.camera, 0.0015, 0)[0], thinned_intrinsics(robot.camera))
    with pytest.raises(dro.DroGraspError, match="nothing stands on the table"):
        sort_out(points, robot.camera.T_world_camera, robot.table)
