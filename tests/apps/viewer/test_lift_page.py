"""The page that plays plans and attempts: its parts called as the browser calls them."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dro_grasp as dro
from dro_grasp.apps.viewer.clear_page import clear_page
from dro_grasp.apps.viewer.film import Film
from dro_grasp.apps.viewer.lift_page import EVERY, LiftPage, lift_page
from dro_grasp.arm.clearing.record import ClearRecorder
from dro_grasp.arm.planning.motion import CHOSEN, STAGES, WAITING, PlanNotes, PlanScene, Trajectory
from dro_grasp.arm.robot_check import robot_shapes, shape_poses
from dro_grasp.arm.robots.loading import BUILTIN_ROBOTS
from dro_grasp.arm.tabletop.animation import Recorder
from dro_grasp.arm.tabletop.attempts import Attempt, write_attempts
from dro_grasp.arm.tabletop.experiment import TabletopConfig
from dro_grasp.cli.main import main
from dro_grasp.cli.view import is_motion
from dro_grasp.errors import OptionError, RobotError
from dro_grasp.network.checkpoints import DEFAULT, describe_weights
from tests.helpers.browser import free_port
from tests.helpers.weights import untrained_weights


@pytest.fixture(scope="module")
def plan(robot: dro.Robot) -> dro.MotionPlan:
    """The second joint moves in the last stage only."""
    k, n = 101, len(robot.hand_joints)
    time, arm = np.linspace(0, 2, k), np.tile(robot.home, (k, 1))
    stage = np.repeat(np.arange(len(STAGES)), [21, 20, 20, 20, 20])
    arm[-20:, 1] -= np.linspace(0, 0.2, 20)
    still, hand = np.zeros_like(arm), np.tile(robot.hand.canonical_joints().double().numpy(), (k, 1))
    wrist = np.tile(robot.T_world_wrist(robot.home), (3, 1, 1))
    notes = PlanNotes(robot.name, "can", robot.arm_joints, robot.hand_joints, "world", 0.0, 3, {"out of reach": 1}, 1, 0, 1.5,
                      wrist[0].tolist(), 0, {"grasps": 1.0})
    scene = PlanScene(np.random.default_rng(0).normal((0.5, 0, 0.05), 0.02, (50, 3)), np.zeros((0, 3)), wrist, hand[:3],
                      np.array([1.5, 1.0, 0.5]), (CHOSEN, "out of reach", WAITING))
    return dro.MotionPlan(notes, scene, stage, Trajectory(time, arm, still, still),
                          Trajectory(time, hand, np.zeros((k, n)), np.zeros((k, n))))


def test_a_plan_is_played_with_its_object_carried(robot: dro.Robot, plan: dro.MotionPlan, tmp_path: Path) -> None:
    plan.save(tmp_path / "plan.npz")
    assert is_motion(tmp_path / "plan.npz")
    page = lift_page(tmp_path / "plan.npz", port=free_port())
    try:
        assert page.film is not None
        last = len(page.film.arm) - 1
        page.show_moment(last)
        expected = shape_poses(robot, plan.arm.position[-1], plan.hand.position[-1])
        assert len(page.arm_view.links) == len(robot_shapes(robot))
        assert np.allclose([handle.position for handle in page.arm_view.links], expected[:, :3, 3], atol=1e-6)
        motion = robot.T_world_wrist(plan.arm.position[-1]) @ np.linalg.inv(robot.T_world_wrist(robot.home))
        assert np.allclose(page._clouds[0].position, motion[:3, 3], atol=1e-6)
        assert np.linalg.norm(motion[:3, 3]) > 0.05
        assert set(page.grasps.options) >= {EVERY, CHOSEN, "out of reach", WAITING}
        page.grasps.value = WAITING
        page._show_layers()
        assert page.server.scene.get_handle_by_name("/grasps").points.shape == (1, 2, 3)  # type: ignore[union-attr]
        assert "3 grasps: 1 out of reach" in page.text.content
    finally:
        page.stop()


def test_played_lifts_say_what_the_joints_say_of_the_hand(robot: dro.Robot, plan: dro.MotionPlan) -> None:
    """Held where the fingers are where the object stops them, empty where they went on; nothing before the lift."""
    n = len(robot.hand_joints)
    squeezed, empty = np.full(n, 0.5), np.full(n, 0.9)
    hold = {"held_joints": squeezed, "held_torque": np.zeros(n), "empty_joints": empty, "empty_torque": np.zeros(n),
            "hold_unit": np.ones(n)}
    told = replace(plan, notes=replace(plan.notes, hold={name: tuple(row.tolist()) for name, row in hold.items()}))
    recorder = Recorder(10.0, plans=[(0, told)])
    for joints in (squeezed, empty):
        recorder.frames += [(robot.home, joints, np.eye(4)[None])] * 15  # of 2 s, of which the last 0.4 s are the lift
    film = Film.of_attempt(recorder)
    assert film.held[:15] == (None,) * 15
    recorder.frames = recorder.frames[::-1]
    late = Film.of_attempt(recorder)
    for made, state in ((film, "empty"), (late, "held")):
        last = made.held[-1]
        assert last is not None
        assert last[0] == state
        assert f"the hand is **{state}**" in made.words[-1]
    assert film.words[0].startswith("**reach**")
    assert film.words[-1].startswith("**after the lift**")
    assert Film.of_plan(robot, plan).held == ()


def test_a_plan_plays_the_same_however_drivers_count(robot: dro.Robot, plan: dro.MotionPlan) -> None:
    draw = np.random.default_rng(0)
    n = len(plan.notes.arm_joints) + len(plan.notes.hand_joints)
    notes = replace(plan.notes, zeros=tuple(draw.uniform(-1, 1, n)), scales=tuple(draw.choice([-1.0, 57.3], n)))
    usual, other = Film.of_plan(robot, plan), Film.of_plan(robot, replace(plan, notes=notes))
    for name in ("arm", "hand", "poses"):
        np.testing.assert_allclose(getattr(other, name), getattr(usual, name), atol=1e-6)


def test_each_attempt_is_played_with_its_own_robot_and_weights(
    robot: dro.Robot, small_robot: str, tmp_path: Path
) -> None:
    other, ran, label = dro.load_robot(small_robot), [], TabletopConfig().label()
    shipped, own = describe_weights()["sha256"], str(untrained_weights(tmp_path))
    stored = [Attempt(robot.name, "can", 0, 0, label, True, "done", robot_file="xarm7_leaphand", weights=own),
              Attempt(other.name, "can", 1, 0, label, True, "done", robot_file=small_robot, weights=DEFAULT,
                      robot_sha256=other.sha256, weights_sha256=shipped, object_sha256="that of another can")]

    def ended(
        used: dro.Robot, obj: object, number: int, seed: int, predictor: dro.GraspPredictor, _: object, recorder: Recorder
    ) -> Attempt:
        ran.append((used.name, number, predictor.weights_name))
        recorder.frames.append((used.home, used.hand.canonical_joints().double().numpy(), np.zeros((0, 4, 4))))
        return stored[number]

    write_attempts(stored, tmp_path / "results.parquet")
    page = lift_page(tmp_path / "results.parquet", port=free_port(), make=ended)
    try:
        assert "Not as stored" not in page.text.content
        page.repeat(1)
        assert ran == [(robot.name, 0, dro.load_weights(own).name), (other.name, 1, DEFAULT)]
        assert page.name.content == f"**{other.name}**"
        assert len(page.arm_view.links) == len(robot_shapes(other)) != len(robot_shapes(robot))
        expected = shape_poses(other, other.home, other.hand.canonical_joints().double().numpy())
        assert np.allclose([handle.position for handle in page.arm_view.links], expected[:, :3, 3], atol=1e-6)
        assert "Not as stored**: with other content than then: object. held" in page.text.content
    finally:
        page.stop()
    lift_page(tmp_path / "results.parquet", 0, small_robot, DEFAULT, port=free_port(), make=ended).stop()
    assert ran[2:] == [(other.name, 0, DEFAULT)], "what is given instead is used"


def test_an_attempt_that_cannot_be_repeated_is_told(
    robot: dro.Robot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = TabletopConfig(clutter=2, noise=0.001)
    assert TabletopConfig.from_label(config.label()) == config
    old = Attempt(robot.name, "can", 0, 0, config.label().replace("tabletop/", "tabletop/0."))
    write_attempts([old], tmp_path / "results.parquet")
    assert is_motion(tmp_path / "results.parquet")
    assert not is_motion(tmp_path / "none.parquet")
    assert main(["view", str(tmp_path / "results.parquet"), "--attempt", "1", "--port", str(free_port())]) == 2
    assert "has attempts 0 to 0; --attempt 1 is none of them" in capsys.readouterr().err
    page = LiftPage(robot, [old], port=free_port())
    try:
        page._guarded(lambda: page.repeat(0))
        assert "another version of dro-grasp (tabletop/0." in page.text.content
        with pytest.raises(dro.DroGraspError, match="nothing to play"):
            Film.of_attempt(Recorder())
    finally:
        page.stop()


def test_words_of_an_attempt_are_those_of_the_plan_that_is_carried_out(robot: dro.Robot, plan: dro.MotionPlan) -> None:
    """As where a thing is pushed to the edge first, and then lifted."""
    n, seconds = len(robot.hand_joints), int(10 * plan.seconds) + 1
    recorder = Recorder(10.0)
    for _ in range(2):
        recorder.plans.append((len(recorder.frames), plan))
        recorder.frames += [(robot.home, np.zeros(n), np.eye(4)[None])] * seconds
    film = Film.of_attempt(recorder)
    assert film.words[:seconds] == film.words[seconds:]
    assert film.words[seconds].startswith("**reach**")


@pytest.mark.parametrize("kind", ["plan", "record"])
def test_a_robot_with_other_joints_is_refused(
    robot: dro.Robot, plan: dro.MotionPlan, small_robot: str, tmp_path: Path, kind: str
) -> None:
    if kind == "plan":
        plan.save(tmp_path / "m.npz")
        with pytest.raises(OptionError, match=r"7 joints in its arm and 6 in its hand, and the plan in .*m.npz 7 and 16"):
            lift_page(tmp_path / "m.npz", robot=small_robot, port=free_port())
    else:
        recorder = ClearRecorder()
        recorder.looked(np.zeros((1, 3)))
        recorder.frames.append((robot.home, robot.open_hand, np.zeros((0, 4, 4))))
        recorder.record(robot).save(tmp_path / "m.npz")
        with pytest.raises(OptionError, match=r"and the record in .*m.npz"):
            clear_page(tmp_path / "m.npz", small_robot, port=free_port())


def test_another_robot_of_the_same_name_is_refused(robot: dro.Robot, plan: dro.MotionPlan, tmp_path: Path) -> None:
    T = robot.T_world_wrist(plan.arm.position[plan.part("approach").stop - 1])
    same = replace(plan, notes=replace(plan.notes, T_world_wrist=T.tolist()))
    same.save(tmp_path / "same.npz")
    lift_page(tmp_path / "same.npz", port=free_port()).stop()
    T[0, 3] += 0.02
    replace(plan, notes=replace(plan.notes, T_world_wrist=T.tolist())).save(tmp_path / "other.npz")
    with pytest.raises(OptionError, match=r"is not the one of the plan in .*other.npz: its wrist is elsewhere"):
        lift_page(tmp_path / "other.npz", port=free_port())


@pytest.mark.parametrize("kind", ["plan", "record"])
def test_the_robot_of_a_file_is_found_where_it_was(
    robot: dro.Robot, plan: dro.MotionPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    shutil.copytree(BUILTIN_ROBOTS, tmp_path / "lab")
    shutil.copy(tmp_path / "lab" / "xarm7_leaphand.yaml", tmp_path / "lab" / "mine.yaml")
    monkeypatch.chdir(tmp_path / "lab")
    mine, file = dro.load_robot("mine.yaml"), tmp_path / "m.npz"
    if kind == "plan":
        T = mine.T_world_wrist(plan.arm.position[plan.part("approach").stop - 1])
        notes = replace(plan.notes, robot="mine", robot_file=mine.source, T_world_wrist=T.tolist())
        replace(plan, notes=notes).save(file)
    else:
        recorder = ClearRecorder()
        recorder.looked(np.zeros((1, 3)))
        recorder.frames.append((mine.home, mine.open_hand, np.zeros((0, 4, 4))))
        recorder.record(mine).save(file)
    monkeypatch.chdir(tmp_path)
    shown = lift_page if kind == "plan" else clear_page
    page = shown(file, port=free_port())
    page.stop()
    assert page.robot.sha256 == robot.sha256
    (tmp_path / "lab" / "mine.yaml").unlink()
    with pytest.raises(RobotError, match=r"the robot of .*m\.npz cannot be loaded: no robot is called .*mine\.yaml"):
        shown(file, port=free_port())
    shown(file, robot="xarm7_leaphand", port=free_port()).stop()


def test_the_attempt_that_is_named_is_the_one_that_is_shown(robot: dro.Robot, tmp_path: Path) -> None:
    label, played = TabletopConfig().label(), list[int]()
    stored = [Attempt(robot.name, "can", i, 0, label, True, "done", robot_file="xarm7_leaphand") for i in range(3)]

    def made(used: dro.Robot, obj: object, number: int, seed: int, predictor: object, _: object, recorder: Recorder) -> Attempt:
        if played and number == 2:
            raise OptionError("it cannot be repeated")
        played.append(number)
        recorder.frames.append((used.home, used.open_hand, np.zeros((0, 4, 4))))
        return stored[number]

    write_attempts(stored, tmp_path / "results.parquet")
    page = lift_page(tmp_path / "results.parquet", 1, port=free_port(), make=made)
    try:
        assert page.picked.value.startswith("1: ")
        page.picked.value = page.labels[0]
        page._pick()
        assert (played, page.picked.value) == ([1, 0], page.labels[0])
        film, page.picked.value = page.film, page.labels[2]
        page._pick()
        assert "it cannot be repeated" in page.text.content
        assert page.film is film
        assert page.picked.value == page.labels[0]
    finally:
        page.stop()
