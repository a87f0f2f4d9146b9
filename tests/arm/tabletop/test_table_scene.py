"""Several things on a table: told apart, avoided, and refused in words where it is not clear which is wanted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dro_grasp as dro
from dro_grasp.arm.planning.physics import LiftScene
from dro_grasp.arm.planning.workcell import VOXEL, Workcell, moved, occupied
from dro_grasp.arm.tabletop.camera_view import depth_image
from dro_grasp.arm.tabletop.table_scene import OVERHANG, pick_object, seen_on_table
from dro_grasp.cli.main import main
from dro_grasp.objects.perception.scene_files import SceneCamera
from dro_grasp.objects.scenery import load_scene

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
    picked = pick_object(load_scene(table_cloud), robot, (0.44, 0.13, 0.03))
    assert np.allclose(picked.obj.cloud.mean(0)[:2], CUBE, atol=2e-3)
    assert np.allclose(np.ptp(picked.obj.cloud, axis=0), 0.06, atol=3e-3)
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
    scene = load_scene(visible @ toward[:3, :3].T + toward[:3, 3], camera=robot.camera.as_seen())
    obj = pick_object(scene, robot, (*CUBE, 0.06)).obj
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


def test_a_speck_is_an_obstacle_too(table_cloud: np.ndarray, robot: dro.Robot) -> None:
    speck = np.array([0.304, 0.304, 0.02]) + 0.004 * np.indices((3, 3, 3)).reshape(3, -1).T
    picked = pick_object(load_scene(np.concatenate([table_cloud[:-3000], speck])), robot, (*CUBE, 0.03))
    (other,) = picked.obstacles
    assert len(occupied(other.cloud.astype(float))[0]) <= 4
    assert np.abs(other.cloud - speck.mean(0)).max() < 3 * VOXEL


def test_obstacles_may_be_larger_than_any_object(table_cloud: np.ndarray, robot: dro.Robot) -> None:
    y, z = np.meshgrid(np.arange(-0.65, 0.65, 0.004), np.arange(0.0, 0.9, 0.004))
    wall = np.stack([np.full(y.size, 0.9), y.ravel(), z.ravel()], 1)
    (other,) = pick_object(load_scene(np.concatenate([table_cloud, wall])), robot, (*CUBE, 0.03)).obstacles
    assert np.ptp(other.cloud, axis=0).max() > 1.0


def test_what_is_beside_the_table_is_left_out(table_cloud: np.ndarray, robot: dro.Robot) -> None:
    assert robot.table is not None
    far = table_cloud[-6000:-3000] + np.array([2.0, 2.0, 0.0])
    scene = load_scene(np.concatenate([table_cloud, far]))
    assert scene.segments.count == 3
    assert seen_on_table(scene, robot).segments.count == 2
    with pytest.raises(dro.DroGraspError, match="shows nothing of the table"):
        seen_on_table(load_scene(far), robot)


def _ending_at(robot: dro.Robot, x: float) -> dro.Robot:
    """The robot with a table that ends at an x [m]."""
    assert robot.table is not None
    return replace(robot, table=replace(robot.table, centre=(x - 0.6, 0.0)))


def test_a_thing_that_the_stated_table_cuts_is_told(table_cloud: np.ndarray, robot: dro.Robot) -> None:
    scene = load_scene(table_cloud)
    short = _ending_at(robot, CUBE[0] - OVERHANG)  # the cut is in the middle of the cube
    for seen in (scene, seen_on_table(scene, short)):  # cut here, or before
        picked = pick_object(seen, short, (CUBE[0] - 0.02, CUBE[1], 0.05))
        (note,) = [note for note in picked.obj.notes if "over the edge" in note]
        assert not any("the cloud's edge" in note for note in picked.obj.notes), "the camera saw all of it"
        assert "reaches 13 cm over the edge of the table of robot" in note
        assert "more than 10 cm beyond the edge" in note
        assert "3 x 6 x 6 cm of the 6 x 6 x 6 cm that are seen are taken. Correct the table's" in note
    turn = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    cut = seen_on_table(scene, short).moved(turn)
    assert cut.whole is not None
    np.testing.assert_allclose(cut.whole.points_seen(), scene.moved(turn).points_seen())
    for x in (CUBE[0] - OVERHANG + 0.035, 1.05):  # overhangs, and is whole
        picked = pick_object(scene, _ending_at(robot, x), (CUBE[0] - 0.02, CUBE[1], 0.05))
        assert not any("over the edge" in note for note in picked.obj.notes)


def test_a_flat_thing_that_the_stated_table_cuts_is_told(robot: dro.Robot) -> None:
    down = np.array([[1.0, 0, 0, 0.45], [0, -1, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]])
    camera = SceneCamera(down, np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]), "world")
    depth, mask = np.full((240, 320), 1.0), np.zeros((240, 320), bool)
    mask[100:140, 145:175] = True  # 10 cm along x
    depth[mask] = 0.99
    scene = load_scene(depth, camera=camera)
    picked = pick_object(scene, _ending_at(robot, 0.45 - OVERHANG), mask=mask)
    assert any("reaches 15 cm over the edge of the table" in note and "5 x 13 x 0 cm of the 10 x 13 x 0 cm" in note
               for note in picked.obj.notes)
    assert not any("over the edge" in note for note in pick_object(scene, robot, mask=mask).obj.notes)


def test_a_thing_beside_the_stated_table_is_told(
    table_cloud: np.ndarray, robot: dro.Robot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = _ending_at(robot, 0.2)
    with pytest.raises(dro.DroGraspError, match=r"shows a thing there, of 6 x 6 x 6 cm at .*, but it is beside the table of "
                       r"robot .* 1\.2 x 1\.4 m about .*Correct the table's `centre`.* On the table: "):
        pick_object(load_scene(table_cloud), short, (*CUBE, 0.03))
    with pytest.raises(dro.DroGraspError, match=r"^'scene' shows no thing within 5 cm|^nothing stands out"):
        pick_object(load_scene(table_cloud), short, (0.15, -0.4, 0.03))
    np.save(tmp_path / "cloud.npy", table_cloud + np.array([1.0, 0, 0]))
    assert main(["plan", "--robot", "xarm7_leaphand", "--scene", str(tmp_path / "cloud.npy"), "--output",
                 str(tmp_path / "plan.npz"), "--at", str(CUBE[0] + 1.0), str(CUBE[1]), "0.03"]) == 2
    assert "but it is beside the table of robot 'xarm7_leaphand'" in " ".join(capsys.readouterr().err.split())


def test_a_slope_is_no_table(table_cloud: np.ndarray, robot: dro.Robot) -> None:
    turn = np.array([[np.cos(0.4), 0, np.sin(0.4), 0.2], [0, 1, 0, 0], [-np.sin(0.4), 0, np.cos(0.4), 0.2], [0, 0, 0, 1]])
    with pytest.raises(dro.DroGraspError, match=r"no level table below .* tilted by 23 degrees"):
        pick_object(load_scene(table_cloud).moved(turn), robot, turn[:3] @ (*CUBE, 0.03, 1))


def test_a_scene_shows_the_height_of_the_table(table_cloud: np.ndarray, robot: dro.Robot) -> None:
    picked = pick_object(load_scene(table_cloud + np.array([0, 0, 0.013])), robot, (*CUBE, 0.03))
    assert picked.robot.table is not None
    assert picked.robot.table.height == pytest.approx(0.013, abs=1e-3)
    assert not any("level plane" in note for note in picked.obj.notes)


@pytest.mark.parametrize(("height", "told"), [(-0.02, "2.0 cm below"), (0.1, "10.0 cm above")])
def test_a_table_elsewhere_than_stated_is_told(
    table_cloud: np.ndarray, robot: dro.Robot, height: float, told: str
) -> None:
    picked = pick_object(load_scene(table_cloud + np.array([0, 0, height])), robot, (*CUBE, 0.03 + height))
    assert any(f"stands on a level plane {told} the table of robot '{robot.name}'" in note for note in picked.obj.notes)


def test_a_table_below_its_stated_height_is_refused(table_cloud: np.ndarray, robot: dro.Robot) -> None:
    """Hands would go through the true one."""
    scene = load_scene(table_cloud - np.array([0, 0, 0.04]))
    with pytest.raises(dro.DroGraspError, match=r"at z = -0\.040 m, .* states 0\.000 m: hands would go through"):
        pick_object(scene, robot, (*CUBE, -0.01))
    board = np.random.default_rng(1).uniform([0.1, 0.2, 0.0], [0.8, 0.65, 1e-3], (20_000, 3))  # and the table beside a recess
    lower = table_cloud - np.array([0, 0, 0.04])
    lower = lower[lower[:, 1] < 0.2]
    picked = pick_object(load_scene(np.concatenate([board, lower])), robot, (*CUBE, -0.01))
    assert picked.robot.table is not None
    assert picked.robot.table.height == pytest.approx(-0.04, abs=2e-3)



@pytest.mark.parametrize(("rows", "options", "said"), [
    (slice(None), [], "shows 2 things"),
    (slice(0, 20_000), [], "nothing stands out"),
    (slice(0, 20_000), ["--at", "0.4", "0", "0"], "nothing stands out"),
    (slice(None), ["--at", "0.4", "0"], "give x, y and z in metres"),
    (slice(None), ["--at", "0.4", "0", "0.3"], "no thing within 5 cm"),
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
    np.save(tmp_path / "cloud.npy", cloud)
    command = ["plan", "--robot", "xarm7_leaphand", "--scene", str(tmp_path / "cloud.npy"), "--output", str(output)]
    assert main([*command, *options]) == 2
    assert said in " ".join(capsys.readouterr().err.split())
    assert not output.exists()


def test_an_empty_table_is_refused_in_words(robot: dro.Robot) -> None:
    scene = LiftScene(Workcell(robot), [dro.load_object("can")])
    aside = np.eye(4)
    aside[:3, 3] = 3.0, 3.0, 0.5
    scene.place(0, aside)
    assert robot.camera is not None
    depth = depth_image(scene, robot.camera, 0.0015, 0)[0]
    with pytest.raises(dro.DroGraspError, match="nothing stands out"):
        pick_object(load_scene(depth, camera=robot.camera.as_seen()), robot)
