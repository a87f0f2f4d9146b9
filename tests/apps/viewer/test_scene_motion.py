"""The page of a scene with a robot: its place, what the arm can carry out, and the motion that is played."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import dro_grasp as dro
from dro_grasp.apps.viewer import scene_motion
from dro_grasp.apps.viewer.film import Film
from dro_grasp.apps.viewer.scene_motion import RobotScenePage, levelled, surroundings
from dro_grasp.apps.viewer.scene_view import HOST, ServedPage
from dro_grasp.arm.planning.motion import ALL_STAGES, CHOSEN, MotionPlan, PlanNotes, PlanScene, Trajectory
from dro_grasp.arm.planning.placing import height_below
from dro_grasp.arm.planning.reachability import Fault
from dro_grasp.arm.planning.task import PlanConfig
from dro_grasp.errors import ObjectError, OptionError, PlanError
from dro_grasp.objects.perception.scene_files import SceneCamera
from dro_grasp.objects.scenery import Scene
from tests.helpers.browser import free_port, use
from tests.helpers.weights import untrained_weights

pytestmark = pytest.mark.filterwarnings("default::DeprecationWarning", "default::ResourceWarning")


def box(low: tuple[float, float, float], high: tuple[float, float, float], seed: int = 0) -> np.ndarray:
    """Points on the surface of a box."""
    random = np.random.default_rng(seed)
    points = random.uniform(low, high, (6000, 3))
    side, axis = random.integers(2, size=6000), random.integers(3, size=6000)
    points[np.arange(6000), axis] = np.where(side, np.array(high)[axis], np.array(low)[axis])
    return points


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Two boxes on a table in front of the robot, and one on a low board that is no table of its."""
    def level(y: float, width: float, z: float) -> np.ndarray:
        x, y = np.meshgrid(np.arange(0.2, 0.9, 0.005), np.arange(y, y + width, 0.005))
        return np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], 1)

    points = np.concatenate([
        level(-0.4, 0.8, 0.0), level(0.5, 0.3, 0.2), box((0.42, -0.03, 0.004), (0.48, 0.03, 0.1)),
        box((0.6, 0.2, 0.004), (0.66, 0.26, 0.08), 1), box((0.5, 0.6, 0.204), (0.56, 0.66, 0.3), 2)])
    T = np.array([[1.0, 0, 0, 0.5], [0, -1, 0, 0.2], [0, 0, -1, 1.2], [0, 0, 0, 1]])  # above, looking down
    return dro.load_scene((points - T[:3, 3]) @ T[:3, :3], "boxes", camera=SceneCamera(T))


def motion_of(robot: dro.Robot, place: bool) -> MotionPlan:
    """Some rows for each stage; the second joint moves."""
    stages = len(ALL_STAGES) if place else 5
    k = 6 * stages
    time, arm = np.linspace(0, 2, k), np.tile(robot.home, (k, 1))
    arm[:, 1] -= np.linspace(0, 0.2, k)
    hand = np.tile(robot.hand.canonical_joints().double().numpy(), (k, 1))
    still = np.eye(4)
    notes = PlanNotes(robot.name, "thing", robot.arm_joints, robot.hand_joints, "world", 0.0, 1, {}, 1, 0, 1.5,
                      still.tolist(), 0, {"grasps": 1.0}, place=still.tolist() if place else None)
    cloud = np.random.default_rng(0).normal((0.5, 0, 0.05), 0.02, (50, 3))
    seen = PlanScene(cloud, np.zeros((0, 3)), still[None], hand[:1], np.array([1.5]), (CHOSEN,))
    return MotionPlan(notes, seen, np.repeat(np.arange(stages), 6), Trajectory(time, arm, 0 * arm, 0 * arm),
                      Trajectory(time, hand, 0 * hand, 0 * hand))


@pytest.fixture
def asked() -> list[dict[str, Any]]:
    """What the planner was asked for."""
    return []


@pytest.fixture
def confident() -> list[float]:
    """The least confidence of the grasps that were asked for, each time."""
    return []


@pytest.fixture
def page(
    scene: Scene, robot: dro.Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: list[dict[str, Any]],
    confident: list[float],
) -> Iterator[RobotScenePage]:
    """Three grasps of anything, of which the arm can carry out the second and third."""
    def predicted(task: Any, predictor: Any) -> Any:
        confident.append(task.least_confidence(0))
        T = torch.eye(4).repeat(3, 1, 1)
        T[:, :3, 3] = torch.from_numpy(task.obj.cloud.mean(0)) + torch.tensor([[0.0, 0, 0.1], [0.1, 0, 0.1], [0, 0.1, 0.1]])
        joints = robot.hand.canonical_joints(0.5).expand(3, -1)
        return lambda seed: dro.GraspBatch.create(robot.hand, task.obj, T, joints, score=torch.tensor([2.0, 1.0, -1.0]))

    def ways(reach: Any, grasps: dro.GraspBatch, index: int) -> Any:
        return Fault.OUT_OF_REACH if float(grasps.score[index]) == 2.0 else SimpleNamespace(index=index)

    def plan(robot: dro.Robot, obj: dro.ObjectModel, **given: Any) -> MotionPlan:
        asked.append(given | {"table": robot.table})
        if len(asked) > 1 and asked[0].get("fail"):
            raise PlanError("no path")
        return motion_of(robot, given["place"] is not None)

    monkeypatch.setattr(scene_motion, "predicted", predicted)
    monkeypatch.setattr(scene_motion, "plan", plan)
    monkeypatch.setattr("dro_grasp.arm.planning.reachability.Reachability.ways", ways)
    monkeypatch.setattr("dro_grasp.arm.planning.reachability.Reachability.hopeless", lambda *_: {})
    served = ServedPage(free_port(), HOST)
    made = RobotScenePage(served.server, dro.GraspPredictor(str(untrained_weights(tmp_path))), scene, robot)
    yield made
    made.close()
    served.stop()


def thing_at(page: RobotScenePage, x: float, y: float) -> int:
    """Number of the thing over a place."""
    middles = [page.cloud.world[page.cloud.labels == k].mean(0)[:2] for k in range(page.cloud.scene.segments.count)]
    return int(np.argmin([np.hypot(*(middle - (x, y))) for middle in middles]))


DOWN = np.array([0.0, 0.0, -1.0])


def test_what_is_offered_without_a_rehearsal_is_as_confident_as_what_generate_returns(
    page: RobotScenePage, confident: list[float]
) -> None:
    """The planner itself asks for less, as it rehearses."""
    page.click(np.array([0.45, 0.0, 1.0]), DOWN)
    assert page.offer is not None, page.status.content
    assert confident == [scene_motion.LEAST_CONFIDENCE]
    assert PlanConfig().doubtful < scene_motion.LEAST_CONFIDENCE


def test_a_thing_its_place_and_its_motion_are_clicked_and_played(
    page: RobotScenePage, asked: list[dict[str, Any]], robot: dro.Robot
) -> None:
    page.click(np.array([0.5, -0.2, 1.0]), DOWN)
    assert "Afterwards, a click on the table says where to put it" in page.status.content
    page.click(np.array([0.45, 0.0, 1.0]), DOWN)
    assert page.offer is not None, page.status.content
    assert page.offer.faults == ("", "", Fault.OUT_OF_REACH)
    assert "The arm can carry out **2**" in page.status.content
    assert page.grasp.options[2] == "3: 88% sure, out of reach"
    page.click(np.array([0.5, -0.2, 1.0]), DOWN)
    x, y = map(float, page.place.value.split())
    assert np.hypot(x - 0.5, y + 0.2) < 0.02
    assert "grasps can put it at" in page.status.content
    assert page.client.scene.get_handle_by_name("/place") is not None
    page._guarded(lambda: page._plan(True))
    assert "is planned" in page.status.content, page.status.content
    spot = asked[-1]["place"].spot
    np.testing.assert_allclose(spot[:2], (x, y), atol=1e-9)
    assert len(asked[-1]["grasps"]) == 1
    assert page.film is not None
    assert "**release**" in "".join(page.film.words)
    page.show_moment(len(page.film.arm) - 1)
    expected = Film.of_plan(robot, motion_of(robot, True)).poses[-1, 0]
    np.testing.assert_allclose(page.cloud.movable.position, expected[:3, 3], atol=1e-5)
    assert "**retreat**" in page.words.content
    page.click(np.array([0.63, 0.23, 1.0]), DOWN)
    assert page.film is None
    assert page.play.disabled
    np.testing.assert_allclose(page.cloud.movable.position, 0.0)


def test_the_place_may_be_typed_and_what_is_no_place_is_told(page: RobotScenePage) -> None:
    page.pick(thing_at(page, 0.45, 0.0))
    page.place.value = "0.5 -0.2 90"
    spot = page.spot()
    assert spot is not None
    np.testing.assert_allclose(spot, (0.5, -0.2, 0.0, math.pi / 2), atol=0.01)
    for wrong in ("here", "0.5", "1 2 3 4", "nan 0"):
        page.place.value = wrong
        with pytest.raises(OptionError, match="give x and y in metres"):
            page.spot()
        page._guarded(page._choose_place)
        assert "**It did not work:**" in page.status.content
    page.place.value = "5 5"
    page._guarded(page._choose_place)
    assert "farther than the arm and hand are long" in page.status.content
    page.place.value = ""
    page._guarded(page._choose_place)
    assert "grasps can lift it" in page.status.content
    assert page.client.scene.get_handle_by_name("/place") is None


def test_a_place_counts_once_it_is_typed_and_nothing_of_it_is_dropped(
    page: RobotScenePage, monkeypatch: pytest.MonkeyPatch
) -> None:
    page.pick(thing_at(page, 0.45, 0.0))
    ranked, begun, go_on = list[str](), threading.Event(), threading.Event()

    def rank() -> None:
        ranked.append(page.place.value)
        begun.set()
        assert go_on.wait(20)

    monkeypatch.setattr(page, "_choose_place", rank)
    keys = [threading.Thread(target=lambda text=text: use(page.place, text)) for text in ("0.4 ", "0.4 -0", "0.4 -0.2")]
    for key in keys:
        key.start()
        time.sleep(0.1)
    assert begun.wait(20)
    last = threading.Thread(target=lambda: use(page.place, "0.4 -0.25"))
    last.start()
    last.join(20)
    go_on.set()
    for key in keys:
        key.join(20)
    assert ranked == ["0.4 -0.2", "0.4 -0.25"]


def test_a_motion_that_plays_is_over_before_the_robot_is_at_home_again(
    page: RobotScenePage, monkeypatch: pytest.MonkeyPatch
) -> None:
    page.pick(thing_at(page, 0.45, 0.0))
    page._guarded(lambda: page._plan(True))
    placed, place = list[float](), page.robot_view.place

    def watched(arm: np.ndarray, hand: np.ndarray) -> None:
        place(arm, hand)
        placed.append(float(np.abs(arm - page.robot.home).max()))

    monkeypatch.setattr(page.robot_view, "place", watched)
    monkeypatch.setattr(page.marks, "show", lambda *_: time.sleep(0.3))  # time for some pictures more
    playing = threading.Thread(target=lambda: use(page.play))
    playing.start()
    while len(placed) < 5:
        time.sleep(0.01)
    page._show()
    playing.join(20)
    assert placed[-1] == 0.0
    np.testing.assert_allclose(page.cloud.movable.position, 0.0)


def test_the_best_that_works_is_looked_for_in_all_of_them_and_a_failure_is_told(
    page: RobotScenePage, asked: list[dict[str, Any]]
) -> None:
    page.pick(thing_at(page, 0.45, 0.0))
    page._guarded(lambda: page._plan(False))
    make = asked[-1]["grasps"]
    assert len(make(0)) == 3
    assert page.made is not None
    asked[0]["fail"] = True
    page._guarded(lambda: page._plan(True))
    assert len(asked) == 1 + scene_motion.SEEDS, "one grasp is tried with several seeds"
    assert "no path. On this page: choose another grasp or place" in page.status.content
    assert page.film is None


def test_a_thing_on_another_surface_has_that_one_as_an_obstacle(scene: Scene, robot: dro.Robot) -> None:
    assert robot.table is not None
    low, high = scene.object_at((0.45, 0.0, 0.05)), scene.object_at((0.53, 0.63, 0.25))
    assert height_below(low.obj) == pytest.approx(0.0, abs=0.005)
    assert height_below(high.obj) == pytest.approx(0.2, abs=0.005)
    assert surroundings(scene, low, robot) is low.obstacles
    around = surroundings(scene, high, robot)
    assert around is not None
    assert high.obstacles is not None
    board = np.abs(around.points[:, 2] - 0.2) < 0.005
    assert board.sum() > 100 + (np.abs(high.obstacles.points[:, 2] - 0.2) < 0.005).sum()
    assert levelled(robot, high.obj, scene) is robot
    raised = replace(low.obj, table=np.array([0.0, 0.0, 1.0, 0.02]))
    table = levelled(robot, raised, scene).table
    assert table is not None
    assert table.height == pytest.approx(0.02)
    assert (table.centre, table.size) == (robot.table.centre, robot.table.size)
    T = np.eye(4)
    T[2, 3] = -0.04
    sunk = scene.moved(T)
    with pytest.raises(ObjectError, match="hands would go through it"):
        levelled(robot, sunk.object_at((0.45, 0.0, 0.01)).obj, sunk)
