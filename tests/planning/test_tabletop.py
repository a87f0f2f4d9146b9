"""The experiment: physics of the scene, what the camera sees, attempts, their storage and their animation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
import trimesh
from PIL import Image

import dro_grasp as dro
from dro_grasp.cli.main import main
from dro_grasp.errors import OptionError
from dro_grasp.models.checkpoints import DEFAULT, load_weights, save_weights
from dro_grasp.perception.scan import depth_points
from dro_grasp.planning import tabletop
from dro_grasp.planning.animation import Recorder, draw_animation
from dro_grasp.planning.attempts import Attempt, TabletopConfig, attempt
from dro_grasp.planning.clutter import rest
from dro_grasp.planning.depth_images import STRIDE, depth_image, thinned_intrinsics
from dro_grasp.planning.physics import LiftScene
from dro_grasp.planning.plan_config import PlanConfig
from dro_grasp.planning.table_scene import clusters, fit_plane, sort_out
from dro_grasp.planning.tabletop import TabletopRun, read_attempts, run_tabletop, write_attempts

QUICK = TabletopConfig(
    see="mesh", hold_seconds=0.5, shake_seconds=0.5, plan=PlanConfig(num=8, best_seconds=30, planner_seconds=30))


@pytest.fixture(scope="module")
def can() -> dro.ObjectModel:
    return dro.load_object("can")


@pytest.fixture(scope="module")
def scene(robot: dro.Robot, can: dro.ObjectModel) -> LiftScene:
    scene = LiftScene(robot, [can])
    assert rest(scene, 0, TabletopConfig().region, np.random.default_rng(0))
    return scene


def test_the_robot_stays_at_home_and_an_object_comes_to_rest_on_the_table(scene: LiftScene, can: dro.ObjectModel) -> None:
    assert np.abs(scene.joints()[0] - scene.robot.home).max() < 1e-3
    vertices = np.asarray(can.vertices) @ scene.pose(0)[:3, :3].T + scene.pose(0)[:3, 3]
    assert abs(vertices[:, 2].min()) < 2e-3
    assert scene.touched(0) == 0


def test_servos_follow_a_trajectory_within_a_degree(robot: dro.Robot, can: dro.ObjectModel) -> None:
    scene = LiftScene(robot, [can])
    hand, worst = scene.joints()[1], 0.0
    for k in range(100):
        target, velocity = robot.home.copy(), np.zeros(7)
        target[0] += 0.3 * (1 - np.cos(np.pi * k / 50))
        velocity[0] = 0.3 * np.pi * np.sin(np.pi * k / 50)
        scene.command(target, velocity, hand)
        scene.advance(0.02)
        worst = max(worst, float(np.abs(scene.joints()[0] - target).max()))
    assert worst < np.radians(2)


def test_depth_is_the_distance_to_the_table_plane(scene: LiftScene, robot: dro.Robot) -> None:
    assert robot.camera is not None
    (depth, _), T = depth_image(scene, robot.camera, 0.0, 0), robot.camera.T_world_camera
    row, column = np.meshgrid(np.arange(depth.shape[0]) * STRIDE, np.arange(depth.shape[1]) * STRIDE, indexing="ij")
    pixels = np.stack([column, row, np.ones_like(row)], -1)
    rays = pixels @ np.linalg.inv(robot.camera.intrinsics).T @ T[:3, :3].T
    expected = -T[2, 3] / rays[..., 2]
    seen = depth > 0
    assert np.isclose(depth[seen], expected[seen], atol=1e-6).mean() > 0.8
    assert (depth[seen] <= expected[seen] + 1e-6).all()


def test_a_camera_sees_the_object_where_it_is_and_nothing_of_the_table(scene: LiftScene, robot: dro.Robot) -> None:
    assert robot.camera is not None
    assert robot.table is not None
    (depth, mask), T = depth_image(scene, robot.camera, 0.0015, 1), robot.camera.T_world_camera
    sight = sort_out(depth_points(depth, thinned_intrinsics(robot.camera)), T, robot.table)
    assert len(sight.points) == pytest.approx(int(mask.sum()), rel=0.1)
    assert abs(sight.table_height) < 1e-3
    in_object = (sight.points @ T[:3, :3].T + T[:3, 3] - scene.pose(0)[:3, 3]) @ scene.pose(0)[:3, :3]
    distance = scene.objects[0].distance_field.distances(torch.from_numpy(in_object).float())[0].abs()
    assert float(distance.median()) < 0.0015
    assert float(distance.quantile(0.95)) < 0.005


def test_a_camera_that_looks_at_the_robot_sees_table_and_object_alone(scene: LiftScene, robot: dro.Robot) -> None:
    assert robot.camera is not None
    T, ahead = np.eye(4), np.array([0.1, 0.0, 0.2]) - (1.3, 0.0, 0.7)
    T[:3, 2], T[:3, 0], T[:3, 3] = ahead / np.linalg.norm(ahead), (0, 1, 0), (1.3, 0.0, 0.7)
    T[:3, 1] = np.cross(T[:3, 2], T[:3, 0])
    depth, mask = depth_image(scene, replace(robot.camera, T_world_camera=T), 0.0, 0)
    points = depth_points(depth, thinned_intrinsics(robot.camera)) @ T[:3, :3].T + T[:3, 3]
    in_object = (points - scene.pose(0)[:3, 3]) @ scene.pose(0)[:3, :3]
    on = scene.objects[0].distance_field.distances(torch.from_numpy(in_object).float())[0].abs().numpy() < 2e-3
    assert (on | (np.abs(points[:, 2]) < 1e-3)).all()
    assert (on[mask[depth > 0]]).all()
    assert mask.sum() > 100
    covered = np.linalg.inv(T) @ robot.T_world_wrist(robot.home)[:, 3]
    column, row = ((thinned_intrinsics(robot.camera) @ covered[:3])[:2] / covered[2]).round().astype(int)
    assert depth[row, column] == 0, "the hand is in view"


def test_a_plane_is_found_under_noise_and_clutter_and_a_wall_is_none() -> None:
    random = np.random.default_rng(0)
    flat = np.column_stack([random.uniform(-1, 1, (800, 2)), random.normal(0.1, 0.001, 800)])
    things = random.uniform([-0.2, -0.2, 0.12], [0.2, 0.2, 0.3], (300, 3))
    plane = fit_plane(np.concatenate([flat, things]))
    assert np.allclose(plane, [0, 0, 1, 0.1], atol=(5e-3, 5e-3, 5e-3, 1e-3))
    with pytest.raises(dro.DroGraspError, match="no level table"):
        fit_plane(flat[:, [2, 0, 1]])
    assert len(set(clusters(np.array([[0, 0, 0], [0, 0, 0.01], [0, 0, 0.1]], float)).tolist())) == 2


def test_an_empty_table_is_refused_in_words(robot: dro.Robot, can: dro.ObjectModel) -> None:
    scene = LiftScene(robot, [can])
    aside = np.eye(4)
    aside[:3, 3] = 3.0, 3.0, 0.5
    scene.place(0, aside)
    assert robot.camera is not None
    assert robot.table is not None
    points = depth_points(depth_image(scene, robot.camera, 0.0015, 0)[0], thinned_intrinsics(robot.camera))
    with pytest.raises(dro.DroGraspError, match="nothing stands on the table"):
        sort_out(points, robot.camera.T_world_camera, robot.table)


def test_an_attempt_lifts_a_can_and_becomes_an_animation(robot: dro.Robot, can: dro.ObjectModel, tmp_path: Path) -> None:
    recorder = Recorder()
    result = attempt(robot, can, 0, 0, dro.GraspPredictor(), QUICK, recorder)
    assert result.stage == "done", result.reason
    assert result.raised > 0.15
    assert len(recorder.frames) == pytest.approx(10 * (result.motion_seconds + 1.0), abs=2)
    recorder.frames = recorder.frames[::20]
    draw_animation(robot, recorder, tmp_path / "lift.gif")
    with Image.open(tmp_path / "lift.gif") as film:
        assert film.n_frames == len(recorder.frames)  # type: ignore[attr-defined]


@pytest.mark.slow
def test_an_attempt_repeats(robot: dro.Robot, can: dro.ObjectModel) -> None:
    first, second = (attempt(robot, can, 0, 0, dro.GraspPredictor(), QUICK) for _ in range(2))
    assert (first.stage, first.raised, first.place) == (second.stage, second.raised, second.place)


def test_attempts_are_stored_and_not_repeated(small_robot: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    output, calls = tmp_path / "results.parquet", []

    def counted(robot: dro.Robot, obj: dro.ObjectModel, number: int, seed: int, *others: object) -> Attempt:
        calls.append(number)
        ended = "done" if number else "plan"
        return Attempt(robot.name, obj.name, number, seed, QUICK.label(), number > 0, ended, "no path", score=0.5)

    monkeypatch.setattr(tabletop, "attempt", counted)
    run = TabletopRun(small_robot, ("can",), attempts=2, config=QUICK)
    first = run_tabletop(run, output)
    assert calls == [0, 1]
    assert run_tabletop(replace(run, attempts=3), output)[:2] == first
    assert calls == [0, 1, 2]
    assert tabletop.endings(first) == {"plan": 1, "done": 1}
    assert tabletop.failures(first) == ["can, attempt 0, plan: no path"]
    stored = read_attempts(output)
    assert len(stored) == 3
    write_attempts(stored[:1], output)
    run_tabletop(run, output)
    assert calls == [0, 1, 2, 1]
    (tmp_path / "other.parquet").write_bytes(b"not this")
    with pytest.raises(dro.DroGraspError, match="expected a file of attempts"):
        run_tabletop(run, tmp_path / "other.parquet")


def test_two_objects_of_one_name_are_refused_and_one_object_counts_once(
    small_robot: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ended(robot: dro.Robot, obj: dro.ObjectModel, number: int, seed: int, *others: object) -> Attempt:
        return Attempt(robot.name, obj.name, number, seed, QUICK.label(), True, "done")

    monkeypatch.setattr(tabletop, "attempt", ended)
    for folder, side in (("003", 0.05), ("004", 0.06)):
        (tmp_path / folder).mkdir()
        trimesh.creation.box((side, side, 0.08)).export(tmp_path / folder / "textured.obj")
    box, other = (str(tmp_path / folder / "textured.obj") for folder in ("003", "004"))
    output = tmp_path / "results.parquet"
    refusal = rf"'{box}' and '{other}' are different objects of the name 'textured'.*rename one"
    with pytest.raises(OptionError, match=refusal):
        run_tabletop(TabletopRun(small_robot, (box, other), attempts=1, config=QUICK), output)
    assert not output.exists()
    again = str(tmp_path / "004" / ".." / "003" / "textured.obj")
    (done,) = run_tabletop(TabletopRun(small_robot, (box, again), attempts=1, config=QUICK), output)
    assert (done.object, done.object_file) == ("textured", box)
    with pytest.raises(OptionError, match=rf"'{other}' is not the object 'textured' .* made with '{box}'.*--output"):
        run_tabletop(TabletopRun(small_robot, (other,), attempts=1, config=QUICK), output)
    whole, half = dro.load_object(box), trimesh.creation.box((0.025, 0.05, 0.08))
    halves = tuple((np.add(half.vertices, [x, 0, 0]), half.faces) for x in (-0.0125, 0.0125))
    with monkeypatch.context() as patch:
        patch.setattr(tabletop, "load_object", lambda source: replace(whole, exact_parts=halves))
        with pytest.raises(OptionError, match=rf"'{box}' is not the object 'textured' .* as it was then"):
            run_tabletop(TabletopRun(small_robot, (box,), attempts=1, config=QUICK), output)
    write_attempts([replace(done, solid_sha256="")], output)  # a file from before this hash
    assert len(run_tabletop(TabletopRun(small_robot, (box,), attempts=1, config=QUICK), output)) == 1
    trimesh.creation.box((0.04, 0.05, 0.08)).export(box)
    with pytest.raises(OptionError, match=rf"'{box}' is not the object 'textured' .* as it was then"):
        run_tabletop(TabletopRun(small_robot, (box,), attempts=1, config=QUICK), output)


def test_attempts_with_other_weights_or_another_robot_are_no_results_of_these(
    small_robot: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []

    def counted(robot: dro.Robot, obj: dro.ObjectModel, number: int, seed: int, *others: object) -> Attempt:
        calls.append(obj.name)
        return Attempt(robot.name, obj.name, number, seed, QUICK.label(), True, "done", score=float(len(calls)))

    def run(output: Path = tmp_path / "results.parquet") -> list[float]:
        return [a.score for a in run_tabletop(TabletopRun(str(file), ("can",), 1, 0, weights, QUICK), output)]

    monkeypatch.setattr(tabletop, "attempt", counted)
    monkeypatch.setattr(tabletop, "GraspPredictor", lambda weights: None)
    text, file, weights = Path(small_robot).read_text(), tmp_path / "robot.yaml", None
    file.write_text(f"{text}\n# a remark changes nothing\n")
    assert run() == [1]
    file.write_text(text)
    assert run() == [1]
    weights = str(tmp_path / f"{DEFAULT}.safetensors")
    save_weights(load_weights(), weights, {"trained": "elsewhere"})
    assert run() == [2], "the name is not enough"
    file.write_text(text.replace("velocity: 2.0", "velocity: 1.25"))
    assert run() == [3]
    assert run() == [3]
    stored = read_attempts(tmp_path / "results.parquet")
    assert [(a.weights, Path(a.robot_file).name) for a in stored] == [
        (DEFAULT, "robot.yaml"), (weights, "robot.yaml"), (weights, "robot.yaml")]
    before = tmp_path / "before.parquet"
    known = pq.read_table(tmp_path / "results.parquet")
    pq.write_table(known.drop_columns(["weights", "weights_sha256", "robot_sha256", "object_sha256"]), before)
    assert len(read_attempts(before)) == 3
    with pytest.raises(OptionError, match=r"before\.parquet holds 3 of these attempts .* give another --output"):
        run(before)
    assert len(read_attempts(before)) == 3


def test_the_command_prints_rates_and_refuses_what_cannot_be(
    small_robot: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(tabletop, "attempt", lambda robot, obj, number, seed, *_: Attempt(
        robot.name, obj.name, number, seed, "", True, "done", processor_seconds=2.0))
    common = ["tabletop", "--robot", small_robot, "--objects", "can", "--attempts"]
    assert main([*common, "4"]) == 0
    said = capsys.readouterr().out
    assert "4 of 4 attempts succeeded (100%, 95 % interval 51% to 100%)" in said
    assert "median 2.0 s" in said
    assert main([*common, "0"]) == 2
    assert main([*common, "1", "--video", str(tmp_path / "film.avi")]) == 2
    assert ".gif or .webp" in capsys.readouterr().err
