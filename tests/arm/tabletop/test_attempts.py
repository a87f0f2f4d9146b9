"""Attempts: objects come to rest, what the camera sees of them, lifts, and their animation."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

import dro_grasp as dro
from dro_grasp.arm.planning.motion import SLIDING, MotionPlan
from dro_grasp.arm.planning.physics import Deviation, LiftScene, object_name
from dro_grasp.arm.planning.task import PlanConfig
from dro_grasp.arm.planning.workcell import Workcell, moved
from dro_grasp.arm.tabletop import experiment
from dro_grasp.arm.tabletop.animation import Recorder, draw_animation
from dro_grasp.arm.tabletop.attempts import Attempt
from dro_grasp.arm.tabletop.camera_view import depth_image
from dro_grasp.arm.tabletop.experiment import PUSHES, TabletopConfig, attempt
from dro_grasp.arm.tabletop.table_scene import PickedObject, pick_object
from dro_grasp.arm.tabletop.table_setup import APART, other_objects, rest, scatter
from dro_grasp.errors import OptionError
from dro_grasp.objects.perception.depth_noise import PRESETS, NoiseName
from dro_grasp.objects.perception.scan import depth_points
from dro_grasp.objects.scenery import load_scene
from dro_grasp.objects.shape import solid_of

QUICK = TabletopConfig(
    see="mesh", hold_seconds=0.5, shake_seconds=0.5, plan=PlanConfig(num=8, best_seconds=30, planner_seconds=30))


@pytest.fixture(scope="module")
def can() -> dro.ObjectModel:
    return dro.load_object("can")


@pytest.fixture(scope="module")
def scene(robot: dro.Robot, can: dro.ObjectModel) -> LiftScene:
    scene = LiftScene(Workcell(robot), [can])
    assert rest(scene, 0, TabletopConfig().region, np.random.default_rng(0))
    return scene


def test_the_robot_stays_at_home_and_an_object_comes_to_rest_on_the_table(scene: LiftScene, can: dro.ObjectModel) -> None:
    assert np.abs(scene.joints()[0] - scene.robot.home).max() < 1e-3
    vertices = np.asarray(can.vertices) @ scene.pose(0)[:3, :3].T + scene.pose(0)[:3, 3]
    assert abs(vertices[:, 2].min()) < 2e-3
    assert scene.touched(0) == 0


def test_depth_is_the_distance_to_the_table_plane(scene: LiftScene, robot: dro.Robot) -> None:
    assert robot.camera is not None
    (depth, _), T = depth_image(scene, robot.camera, 0.0, 0), robot.camera.T_world_camera
    assert depth.shape == (robot.camera.height, robot.camera.width)
    row, column = np.meshgrid(np.arange(depth.shape[0]), np.arange(depth.shape[1]), indexing="ij")
    pixels = np.stack([column, row, np.ones_like(row)], -1)
    rays = pixels @ np.linalg.inv(robot.camera.intrinsics).T @ T[:3, :3].T
    expected = -T[2, 3] / rays[..., 2]
    seen = depth > 0
    assert np.isclose(depth[seen], expected[seen], atol=1e-6).mean() > 0.8
    assert (depth[seen] <= expected[seen] + 1e-6).all()


def _picked(depth: np.ndarray, robot: dro.Robot) -> tuple[PickedObject, np.ndarray]:
    """The only thing of a depth image, and its points in the camera's frame [m]."""
    assert robot.camera is not None
    view = load_scene(depth, camera=robot.camera.as_seen())
    assert view.sight is not None
    return pick_object(view, robot), view.sight.points[view.chosen().own]


def test_a_camera_sees_the_object_where_it_is_and_nothing_of_the_table(scene: LiftScene, robot: dro.Robot) -> None:
    assert robot.camera is not None
    assert robot.table is not None
    (depth, mask), T = depth_image(scene, robot.camera, 0.0015, 1), robot.camera.T_world_camera
    seen, points = _picked(depth, robot)
    assert len(points) == pytest.approx(int(mask.sum()), rel=0.1)
    assert seen.robot.table is not None
    assert abs(seen.robot.table.height) < 1e-3
    in_object = (points @ T[:3, :3].T + T[:3, 3] - scene.pose(0)[:3, 3]) @ scene.pose(0)[:3, :3]
    distance = scene.objects[0].distance_field.distances(torch.from_numpy(in_object).float())[0].abs()
    assert float(distance.median()) < 0.0015
    assert float(distance.quantile(0.95)) < 0.005


@pytest.mark.parametrize("name", ["structured_light", "time_of_flight", "stereo"])
def test_the_table_has_the_noise_of_a_kind_of_camera(scene: LiftScene, robot: dro.Robot, name: NoiseName) -> None:
    camera = robot.camera
    assert camera is not None
    (true, mask), T = depth_image(scene, camera, 0.0, 0), camera.T_world_camera
    table = (true > 0) & ~mask
    rays = depth_points(np.ones(true.shape), camera.intrinsics).reshape(*true.shape, 3)
    cosine = np.abs(rays @ T[2, :3]) / np.linalg.norm(rays, axis=-1)
    there, error = np.zeros(true.shape, int), []
    for seed in range(3):
        depth, again = depth_image(scene, camera, name, seed)
        assert np.array_equal(again, mask)
        near = table & (depth > 0) & (np.abs(depth - true) < 0.02)
        there += near
        error.append(((depth - true) / PRESETS[name].deviation(np.maximum(true, 0.1), np.arccos(cosine)))[near])
    assert np.concatenate(error).std() == pytest.approx(1.0, abs=0.1)
    assert (there[table] > 0).mean() > 0.9
    seen, points = _picked(depth, robot)
    assert seen.robot.table is not None
    assert abs(seen.robot.table.height) < 1e-3
    assert len(points) == pytest.approx(int(mask.sum()), rel=0.25)


def test_a_camera_that_looks_at_the_robot_sees_table_and_object_alone(scene: LiftScene, robot: dro.Robot) -> None:
    assert robot.camera is not None
    T, ahead = np.eye(4), np.array([0.1, 0.0, 0.2]) - (1.3, 0.0, 0.7)
    T[:3, 2], T[:3, 0], T[:3, 3] = ahead / np.linalg.norm(ahead), (0, 1, 0), (1.3, 0.0, 0.7)
    T[:3, 1] = np.cross(T[:3, 2], T[:3, 0])
    depth, mask = depth_image(scene, replace(robot.camera, T_world_camera=T), 0.0, 0)
    points = depth_points(depth, robot.camera.intrinsics) @ T[:3, :3].T + T[:3, 3]
    in_object = (points - scene.pose(0)[:3, 3]) @ scene.pose(0)[:3, :3]
    on = scene.objects[0].distance_field.distances(torch.from_numpy(in_object).float())[0].abs().numpy() < 2e-3
    assert (on | (np.abs(points[:, 2]) < 1e-3)).all()
    assert (on[mask[depth > 0]]).all()
    assert mask.sum() > 100
    covered = np.linalg.inv(T) @ robot.T_world_wrist(robot.home)[:, 3]
    column, row = ((robot.camera.intrinsics @ covered[:3])[:2] / covered[2]).round().astype(int)
    assert depth[row, column] == 0, "the hand is in view"


def test_an_attempt_lifts_a_can_and_becomes_an_animation(
    robot: dro.Robot, can: dro.ObjectModel, tmp_path: Path, compiled: list[mujoco.MjSpec]
) -> None:
    robot, recorder = replace(robot, home=robot.home - 1e-3), Recorder()  # no other test has this home
    compiled.clear()
    result = attempt(robot, can, 0, 0, dro.GraspPredictor(), QUICK, recorder)
    assert result.stage == "done", result.reason
    assert result.raised > 0.15
    assert len(compiled) == 5, "the table of the attempt, beside the four models of a plan"
    assert len(recorder.frames) == pytest.approx(10 * (result.motion_seconds + 1.0), abs=2)
    recorder.frames = recorder.frames[::20]
    draw_animation(robot, recorder, tmp_path / "lift.gif")
    with Image.open(tmp_path / "lift.gif") as film:
        assert film.n_frames == len(recorder.frames)  # type: ignore[attr-defined]


@pytest.mark.slow
def test_an_attempt_repeats(robot: dro.Robot, can: dro.ObjectModel) -> None:
    first, second = (attempt(robot, can, 0, 0, dro.GraspPredictor(), QUICK) for _ in range(2))
    assert (first.stage, first.raised, first.place) == (second.stage, second.raised, second.place)


def test_a_frame_far_from_the_object_moves_nothing(robot: dro.Robot, can: dro.ObjectModel) -> None:
    """As files of machine parts have it: the origin of their assembly."""
    away = np.eye(4)
    away[:3, 3] = 0.6, 0.2, 0.1
    region, base = (0.4, -0.1, 0.45, 0.1), robot.T_world_base[:2, 3]
    places = []
    for obj in (can, moved(can, away)):
        scene = LiftScene(Workcell(robot), [obj])
        assert rest(scene, 0, region, np.random.default_rng(3))
        places.append(scene.centre(0))
        assert (np.array(region[:2]) - 0.05 < scene.centre(0)[:2] - base).all()
        assert (scene.centre(0)[:2] - base < np.array(region[2:]) + 0.05).all()
    np.testing.assert_allclose(*places, atol=5e-3)


def test_a_turn_in_the_hand_is_no_slip(robot: dro.Robot, can: dro.ObjectModel) -> None:
    shift = trimesh.transformations.translation_matrix
    scene, T = LiftScene(Workcell(robot), [moved(can, shift((0.8, 0.0, 0.0)))]), shift((0.0, 0.0, 0.5))
    scene.place(0, T)
    where, centre = scene.centre_in_hand(0), scene.centre(0)
    np.testing.assert_allclose(centre, scene.objects[0].centre_of_mass + T[:3, 3], atol=1e-9)
    turn = trimesh.transformations.rotation_matrix(0.3, (0, 1, 0), centre)
    scene.place(0, turn @ T)
    np.testing.assert_allclose(scene.centre_in_hand(0), where, atol=1e-9)
    in_hand = scene.in_hand(0) @ [*scene.objects[0].centre_of_mass, 1]
    np.testing.assert_allclose(in_hand[:3], where, atol=1e-9)


def test_attempts_with_other_objects_draw_other_places(robot: dro.Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []

    def scattered(scene: LiftScene, region: object, draw: np.random.Generator) -> bool:
        drawn.append(draw.uniform())
        return False

    monkeypatch.setattr(experiment, "scatter", scattered)
    for name in ("can", "torus", "can"):
        attempt(robot, dro.load_object(name), 0, 0, dro.GraspPredictor(), QUICK)
    assert drawn[0] == drawn[2] != drawn[1]


def test_clutter_stands_on_the_table_around_the_object(robot: dro.Robot) -> None:
    can, config = dro.load_object("can"), TabletopConfig(clutter=2)
    others = other_objects("can", 2, np.random.default_rng(0))
    assert "can" not in {o.name for o in others}
    scene = LiftScene(Workcell(robot), [can, *others])
    assert scatter(scene, config.region, np.random.default_rng(1))
    clouds = [o.cloud @ scene.pose(i)[:3, :3].T + scene.pose(i)[:3, 3] for i, o in enumerate(scene.objects)]
    for i, cloud in enumerate(clouds):
        assert abs(cloud[:, 2].min()) < 3e-3
        for other in clouds[:i]:
            assert np.linalg.norm(cloud[::20, None] - other[None, ::20], axis=-1).min() > APART / 3
    with pytest.raises(dro.DroGraspError, match="clutter is 9"):
        TabletopConfig(clutter=9)
    with pytest.raises(dro.DroGraspError, match=r"region is \(0.5, 0.0, 0.4, 0.1\); give two corners"):
        TabletopConfig(region=(0.5, 0.0, 0.4, 0.1))


@pytest.mark.parametrize("see", ["mesh", "cloud"])
def test_a_stated_mass_is_lifted_and_planned_for(
    robot: dro.Robot, can: dro.ObjectModel, see: Literal["mesh", "cloud"], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What stands beside it keeps its own mass; the attempt ends where the plan would begin."""
    known, scenes = [], []
    honest = experiment.scatter

    def scattered(scene: LiftScene, *rest: Any) -> bool:
        scenes.append(scene)
        return honest(scene, *rest)

    def unplanned(robot: dro.Robot, obj: dro.ObjectModel, *rest: Any, place: None) -> None:
        known.append(obj)
        raise dro.DroGraspError("not planned")

    monkeypatch.setattr(experiment, "scatter", scattered)
    monkeypatch.setattr(experiment, "plan", unplanned)
    for mass in (0.4, None):
        config = replace(QUICK, see=see, mass=mass, clutter=1)
        made = attempt(robot, can, 0, 0, dro.GraspPredictor(), config)
        assert made.reason == "not planned"
        bodies = [scenes[-1].model.body(object_name(i)).mass[0] for i in range(2)]
        assert bodies == pytest.approx([mass or can.mass, scenes[-1].objects[1].mass])
        assert known[-1].stated_mass == mass
    assert solid_of(known[0]).mass == pytest.approx(0.4, rel=1e-6)


def test_settings_go_through_labels_and_back() -> None:
    heavy = TabletopConfig(mass=0.4)
    assert TabletopConfig.from_label(heavy.label()) == heavy
    assert "mass" not in TabletopConfig().label(), "attempts that were stored before masses could be stated stay valid"
    assert TabletopConfig.from_label(TabletopConfig().label()) == TabletopConfig()
    wanted = dro.Constraints((0.0, 0.0, -1.0), max_tilt=0.5, pregrasp_clearance=0.01)
    config = TabletopConfig(plan=dro.PlanConfig(constraints=wanted))
    assert TabletopConfig.from_label(config.label()) == config
    assert config.label() != TabletopConfig().label()
    heavier = TabletopConfig(plan=dro.PlanConfig(deviations=(Deviation((0.01, 0.0), 0.5, 2.0),)))
    assert TabletopConfig.from_label(heavier.label()) == heavier


def test_settings_that_cannot_be_stored_are_refused() -> None:
    with pytest.raises(OptionError, match="attempts are stored with their settings, so give a name"):
        TabletopConfig(plan=dro.PlanConfig(source=dro.GraspPredictor().source("optimiser")))
    with pytest.raises(OptionError, match="no deviations to rehearse lifts with"):
        dro.PlanConfig(deviations=())


@pytest.mark.parametrize("pushes", [2, 99])
def test_a_thing_is_judged_from_where_pushes_left_it_and_they_have_an_end(
    robot: dro.Robot, can: dro.ObjectModel, planned: MotionPlan, monkeypatch: pytest.MonkeyPatch, pushes: int
) -> None:
    """What is planned and carried out is made up; each push moves the can by 5 cm."""
    made, starts = list[MotionPlan](), list[np.ndarray]()

    def plans(*arguments: object, **given: object) -> MotionPlan:
        pushing = len(made) < pushes
        made.append(replace(planned, notes=replace(planned.notes, slide=np.eye(4).tolist() if pushing else None)))
        return made[-1]

    def push(scene: LiftScene, *others: object) -> None:
        T = scene.pose(0)
        T[0, 3] += 0.05 / len(SLIDING)
        scene.place(0, T)

    def judged(result: Attempt, scene: LiftScene, start: np.ndarray, plan: MotionPlan) -> Attempt:
        starts.append(start)
        return replace(result, place_error=0.0, place_tilt=0.0)

    monkeypatch.setattr(experiment, "may_slide", lambda *_: True)
    monkeypatch.setattr(experiment, "plan_or_slide", plans)
    monkeypatch.setattr(LiftScene, "follow", push)
    monkeypatch.setattr(experiment, "carry_out", lambda *_: ("done", ""))
    monkeypatch.setattr(experiment, "measured", judged)
    done = attempt(robot, can, 0, 0, dro.GraspPredictor(), TabletopConfig(see="mesh", place=True))
    if pushes > 2:
        assert (done.pushes, done.stage) == (PUSHES, "slide")
        assert f"after {PUSHES} pushes" in done.reason
        return
    assert done.success
    first = np.array(json.loads(done.place))
    assert starts[0][0, 3] == pytest.approx(first[0, 3] + 0.1, abs=1e-5)
    assert abs(done.raised) < 1e-3
