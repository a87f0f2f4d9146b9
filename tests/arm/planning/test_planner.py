"""Plans: collision-free at ten times their resolution, within limits, straight where they should be, and refused in words."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import trimesh
import yaml
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

import dro_grasp as dro
import dro_grasp.arm.robots.robot as dro_robot
from dro_grasp.arm.planning.candidates import grasps_in_world
from dro_grasp.arm.planning.motion import STAGES, MotionPlan
from dro_grasp.arm.planning.physics import Deviation
from dro_grasp.arm.planning.planner import ALIKE, ALIKE_TURN, Tries, add, failed_before, plan
from dro_grasp.arm.planning.reachability import Fault
from dro_grasp.arm.planning.task import PlanConfig, Task, table_below
from dro_grasp.arm.planning.workcell import Workcell, arm_addresses, robot_spec
from dro_grasp.arm.robots.loading import BUILTIN_ROBOTS
from dro_grasp.cli.main import main
from dro_grasp.errors import NoGraspError, OptionError, PlanError, RobotError
from dro_grasp.extras import EXTRAS
from dro_grasp.predict.admission import PLANE
from dro_grasp.predict.config import GraspRequest
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.stages import complete
from dro_grasp.simulation.protocols import PROTOCOLS
from dro_grasp.simulation.scene import joint_addresses

FINER = 10


def finer(made: MotionPlan) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Time, stage, arm and hand at ten times the resolution."""
    time = np.linspace(0, made.seconds, FINER * len(made.arm.time))
    stage = made.stage[np.searchsorted(made.arm.time, time).clip(max=len(made.stage) - 1)]
    arm, hand = (np.stack([np.interp(time, made.arm.time, c) for c in t.position.T], 1) for t in (made.arm, made.hand))
    return time, stage, arm, hand


def test_a_plan_touches_nothing_at_ten_times_its_resolution(
    planned: MotionPlan, robot: dro.Robot, wall: dro.ObjectModel, standing: tuple[dro.ObjectModel, np.ndarray]
) -> None:
    """The robot and the table as plain MuJoCo has them; wall and object by signed distances of the hand's surface points."""
    scene = robot_spec(robot, PROTOCOLS["dro"], robot.table)
    for a, b in Workcell(robot).excluded:
        scene.add_exclude(bodyname1=a, bodyname2=b)
    model = scene.compile()
    data = mujoco.MjData(model)
    (fingers, moving), tree = joint_addresses(model, robot.hand), robot.hand.tree
    _, stage, arm, hand = finer(planned)
    full = hand @ tree.coupling.double().numpy().T + tree.offset.double().numpy()
    for q, joints in zip(arm, full[:, moving], strict=True):
        data.qpos[arm_addresses(model, robot)], data.qpos[fingers] = q, joints
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        pairs = [sorted(model.body(model.geom_bodyid[g]).name for g in c.geom) for c in data.contact if c.dist < 0]
        assert all(a.startswith("hand/") and b.startswith("hand/") for a, b in pairs), pairs
    wrist = torch.from_numpy(robot.T_world_wrist(arm)).float()
    points = robot.hand.points(torch.from_numpy(hand).float(), wrist)
    assert float(wall.distance_field.distances(points)[0].min()) > 0
    obj, T = standing
    travelling = points[torch.from_numpy(stage <= STAGES.index("shape"))]
    in_object = travelling @ torch.from_numpy(T[:3, :3]).float() - torch.from_numpy(T[:3, 3]).float()
    assert float(obj.distance_field.distances(in_object)[0].min()) > 0


def test_a_plan_has_the_forces_of_its_grasp(robot: dro.Robot, standing: tuple[dro.ObjectModel, np.ndarray]) -> None:
    """Which the predictor states for each grasp; here its joints tell whose they are."""
    class Pressing(dro.GraspPredictor):
        def rounds(self, *arguments: Any) -> Iterator[dro.GraspBatch]:
            for made in super().rounds(*arguments):
                joints = made.joints
                yield made.replace(
                    squeeze_torque=0.01 * joints, payload=joints.abs().sum(1), squeeze_force=torch.full((len(joints),), 6.25))

    made = plan(robot, *standing, predictor=Pressing(), config=PlanConfig(num=12), seed=0)
    joints = made.scene.joints[made.notes.chosen]
    np.testing.assert_allclose(made.notes.squeeze_torque, 0.01 * joints, rtol=1e-5, atol=1e-8)
    assert made.notes.payload == pytest.approx(np.abs(joints).sum(), rel=1e-5)
    assert made.notes.squeeze_force == 6.25


@pytest.mark.parametrize(("weight", "score", "asked"), [(1.0, -1.9, 1), (100.0, -1.9, 3), (1.0, -2.1, 3)])
def test_what_holds_in_all_rehearsals_is_taken_at_once_though_its_score_is_low(
    robot: dro.Robot, standing: tuple[dro.ObjectModel, np.ndarray], weight: float, score: float, asked: int
) -> None:
    """What lets go in one of two, or is doubtful, is taken only once a batch has no more grasps."""
    shown = []

    class Doubting(dro.GraspPredictor):
        def rounds(self, *arguments: Any) -> Iterator[dro.GraspBatch]:
            made = next(iter(super().rounds(*arguments)))
            for _ in range(3):
                shown.append(len(made))
                yield made.replace(score=torch.full((len(made),), score))

    made = plan(robot, *standing, predictor=Doubting(), seed=0, config=PlanConfig(
        num=12, deviations=(Deviation(), Deviation(weight=weight))))
    assert len(shown) == asked
    assert made.notes.score == pytest.approx(score)
    assert made.notes.rehearsed == 1 / len({1.0, weight})


@pytest.mark.parametrize(("score", "least", "tried"), [(-1.9, None, True), (-2.1, None, False), (-2.1, 0.0, True)])
def test_what_loses_the_object_in_its_rehearsal_is_tried_last_unless_it_is_hopeless_anyway(
    robot: dro.Robot, standing: tuple[dro.ObjectModel, np.ndarray], score: float, least: float | None, tried: bool
) -> None:
    """Here the object is far too heavy in the rehearsal. At these scores, 13 and 11 % hold; who asks for all gets all."""
    class Doubting(dro.GraspPredictor):
        def rounds(self, *arguments: Any) -> Iterator[dro.GraspBatch]:
            made = next(iter(super().rounds(*arguments)))
            yield made.replace(score=torch.full((len(made),), score))

    config = PlanConfig(batches=1, deviations=(Deviation(weight=1000.0),), least_confidence=least)
    if tried:
        assert plan(robot, *standing, predictor=Doubting(), seed=0, config=config).notes.rehearsed == 0
    else:
        with pytest.raises(PlanError, match=Fault.LOSES):
            plan(robot, *standing, predictor=Doubting(), seed=0, config=config)


def test_given_grasps_are_not_doubtful_whatever_they_score(
    robot: dro.Robot, standing: tuple[dro.ObjectModel, np.ndarray]
) -> None:
    """Another method's scores may mean anything: one batch is enough, and what loses the object is carried out all the same."""
    wanted, seeds = Constraints(table=robot.table.height), []
    found = grasps_in_world(dro.GraspPredictor(), robot.hand, *standing, GraspRequest(8, 0), wanted)

    def given(seed: int) -> dro.GraspBatch:
        seeds.append(seed)
        return found.replace(score=torch.full((len(found),), -9.0))

    def share(weight: float, batches: int) -> float | None:
        config = PlanConfig(deviations=(Deviation(weight=weight),), batches=batches)
        return plan(robot, *standing, grasps=given, config=config).notes.rehearsed

    assert (share(1.0, 3), len(seeds)) == (1, 1)
    assert share(1000.0, 1) == 0


def test_the_check_above_sees_a_plan_that_goes_through_the_wall(
    robot: dro.Robot, wall: dro.ObjectModel, standing: tuple[dro.ObjectModel, np.ndarray], planned: MotionPlan
) -> None:
    goal = planned.arm.position[planned.part("shape")][0]
    straight = np.linspace(robot.home, goal, 200)
    opened = torch.from_numpy(planned.hand.position[0]).float().expand(200, -1)
    points = robot.hand.points(opened, torch.from_numpy(robot.T_world_wrist(straight)).float())
    cell = Workcell(robot, [wall], *standing)
    free = [cell.free(q, planned.hand.position[0], 0.0) for q in straight]
    inside = wall.distance_field.distances(points)[0].amin(-1) < -0.003
    assert not any(f and bool(i) for f, i in zip(free, inside, strict=True))


def test_limits_hold_by_finite_differences(planned: MotionPlan, robot: dro.Robot) -> None:
    limits = [(planned.arm, robot.velocity, robot.acceleration),
              (planned.hand, robot.hand_velocity, robot.hand_acceleration)]
    assert (planned.arm.position >= robot.lower).all()
    assert (planned.arm.position <= robot.upper).all()
    for part, velocity, acceleration in limits:
        step = np.diff(part.time)[:, None]
        assert (step > 0).all()
        speed = np.diff(part.position, axis=0) / step
        assert (np.abs(speed) <= velocity * 1.001).all()
        assert (np.abs(part.velocity) <= velocity * 1.001).all()
        assert (np.abs(part.acceleration) <= acceleration * 1.001).all()
        change = np.diff(speed, axis=0) / ((step[1:] + step[:-1]) / 2)
        assert (np.abs(change) <= acceleration * 1.1).all()


def test_approach_and_lift_are_straight_and_stages_follow_each_other(planned: MotionPlan, robot: dro.Robot) -> None:
    assert sorted(set(planned.stage.tolist())) == list(range(len(STAGES)))
    assert (np.diff(planned.stage) >= 0).all()
    assert np.allclose(planned.arm.position[0], robot.home)
    wrist = robot.T_world_wrist(planned.arm.position)
    grasp = np.array(planned.notes.T_world_wrist)
    ahead = robot.hand.palm_directions(torch.from_numpy(grasp)[None].float())[0].double().numpy()
    for stage, direction, length in (("approach", ahead, 0.1), ("lift", np.array([0, 0, 1.0]), 0.2)):
        poses = wrist[planned.part(stage)]
        way = poses[:, :3, 3] - poses[0, :3, 3]
        assert np.allclose(way[-1], length * direction, atol=2e-3)
        assert np.abs(way - (way @ direction)[:, None] * direction).max() < 2e-3
        turned = np.einsum("nij,ij->n", poses[:, :3, :3], grasp[:3, :3])
        assert (np.arccos(np.clip((turned - 1) / 2, -1, 1)) < 0.01).all()
    assert np.allclose(wrist[planned.part("close")], grasp, atol=5e-3)


def test_grasps_like_those_that_failed_are_known_by_place_and_turn(planned: MotionPlan, robot: dro.Robot) -> None:
    wrists = torch.from_numpy(planned.scene.T_world_wrist).float()
    joints = torch.from_numpy(planned.scene.joints).float()
    grasps = dro.GraspBatch.create(robot.hand, dro.load_object("can"), wrists, joints)
    for row in range(3):
        other = wrists[row].double().numpy()
        apart = np.linalg.norm(planned.scene.T_world_wrist[:, :3, 3] - other[:3, 3], axis=1)
        turned = Rotation.from_matrix(planned.scene.T_world_wrist[:, :3, :3] @ other[:3, :3].T).magnitude()
        near = np.flatnonzero((apart < ALIKE) & (turned < ALIKE_TURN)).tolist()
        assert row in near
        assert failed_before(grasps, [other]) == near
    assert failed_before(grasps, []) == []


def test_what_was_dropped_adds_up(planned: MotionPlan) -> None:
    notes = planned.notes
    assert notes.goals >= 1
    assert sum(notes.dropped.values()) + notes.goals <= notes.grasps == 12
    assert planned.lines()[0].startswith("12 grasps: ")


def test_what_touches_the_robot_at_home_is_named(
    robot: dro.Robot, wall: dro.ObjectModel, standing: tuple[dro.ObjectModel, np.ndarray]
) -> None:
    can, T = standing
    elbow = trimesh.creation.box((0.2, 0.2, 0.2), trimesh.transformations.translation_matrix((0.0, 0.0, 0.3)))
    seen = dro.load_scene(trimesh.sample.sample_surface(elbow, 2000, seed=0)[0])
    config = PlanConfig(constraints=dro.Constraints(obstacles=replace(seen, name="cell")))
    with pytest.raises(PlanError, match=r"obstacle 'cell' collides with arm/link\d .* by .* mm; cut the robot out of"):
        plan(robot, can, T, [wall], config=config)
    assert robot.table is not None
    raised = replace(robot, table=replace(robot.table, height=robot.T_world_wrist(robot.home)[2, 3]))
    with pytest.raises(RobotError, match=r"(arm|hand)/\w+ and table, by .* mm; correct `table` in the robot file"):
        plan(raised, can, trimesh.transformations.translation_matrix((0.5, 0.1, 0.6)), [wall])


def test_a_maker_of_grasps_that_finds_none_is_asked_again(
    robot: dro.Robot, standing: tuple[dro.ObjectModel, np.ndarray]
) -> None:
    asked = list[int]()

    def none(seed: int) -> dro.GraspBatch:
        asked.append(seed)
        raise NoGraspError("none with this seed")

    with pytest.raises(PlanError, match="none with this seed"):
        plan(robot, *standing, config=PlanConfig(batches=2), grasps=none)
    assert len(asked) == 2


def test_other_constraints_do_not_make_a_table_of_the_plane_in_a_cloud(
    robot: dro.Robot, standing: tuple[dro.ObjectModel, np.ndarray], planned: MotionPlan
) -> None:
    """Here it is far above the thing; the robot's own table is what counts."""
    can, T = standing
    above = replace(can, table=np.array([0.0, 0.0, 1.0, 1.0], np.float32))
    task = Task.of(robot, above, T, (), PlanConfig(constraints=dro.Constraints(max_force=50.0)), 0)
    wrists, joints = (torch.from_numpy(a).float() for a in (planned.scene.T_world_wrist, planned.scene.joints))
    grasps, tries = dro.GraspBatch.create(robot.hand, above, wrists, joints), Tries()
    add(task, tries, complete(GraspProblem(robot.hand, can), grasps))
    assert PLANE not in tries.counts
    assert len(tries.waiting) > 0


def test_without_a_table_the_one_that_was_seen_counts(
    robot: dro.Robot, standing: tuple[dro.ObjectModel, np.ndarray]
) -> None:
    can, T = standing
    low = float((can.cloud @ T[:3, :3].T + T[:3, 3])[:, 2].min())
    assert table_below(robot, can, T).height == pytest.approx(low)
    seen = replace(can, table=np.array([0.0, 0.0, 1.0, low - T[2, 3] - 0.03], np.float32))
    assert table_below(robot, seen, T).height == pytest.approx(low - 0.03, abs=1e-6)


def test_each_batch_of_grasps_is_another_one(
    robot: dro.Robot, standing: tuple[dro.ObjectModel, np.ndarray]
) -> None:
    asked: list[int] = []

    def nowhere(seed: int) -> dro.GraspBatch:
        asked.append(seed)
        away, hand = torch.eye(4).repeat(2, 1, 1), robot.hand
        away[:, 2, 3] = 9.0
        q = hand.canonical_joints().repeat(2, 1)
        return dro.GraspBatch.create(hand, standing[0], away, q, score=torch.zeros(2), pregrasp_joints=q, squeeze_joints=q)

    with pytest.raises(PlanError, match="6 grasps: 6 out of reach"):
        plan(robot, *standing, config=PlanConfig(num=2, batches=3), seed=7, grasps=nowhere)
    assert asked[0] == 7
    assert len(set(asked)) == 3


def test_what_an_object_in_the_hand_could_meet_is_an_obstacle(robot: dro.Robot) -> None:
    can = dro.load_object("can")
    line = np.linspace([0.5, 0, 1.0], [0.5, 0, 4.0], 3000)
    config = dro.PlanConfig(constraints=dro.Constraints(obstacles=dro.load_scene(line)))
    (thing,) = Task.of(robot, can, np.eye(4), [], config, 0).cell.obstacles
    within = np.linalg.norm(thing.cloud - robot.T_world_base[:3, 3], axis=1).max()
    arm = np.random.default_rng(0).uniform(*robot.working_range, (200, len(robot.home)))
    T = torch.from_numpy(np.linalg.inv(robot.T_world_base) @ robot.T_world_wrist(arm)).float()
    fingers = robot.hand.points(robot.hand.canonical_joints().expand(len(T), -1), T).norm(dim=-1).max()
    assert within >= float(fingers) + pdist(np.asarray(can.vertices)[::5]).max()
    assert within < robot.full_reach + 0.5


BAD = {
    "far away": (["--at", "3", "0"], "farther than the arm and hand are long"),
    "in the robot": (["--at", "0.0", "0.0"], "while the robot is at home"),
    "under the table": (["--pose", "low.json"], "below the table"),
    "no rigid camera": (["--camera", "squashed.json"], "is not a rotation"),
    "two places": (["--at", "0.5", "0", "--pose", "low.json"], "give one of them"),
    "no grasps": (["--num", "0"], "num is 0"),
    "no folder": (["--csv", "nowhere/plan.csv"], "no folder"),
}


def test_a_pose_that_is_none_is_refused_and_not_taken_for_the_table_s_fault(robot: dro.Robot) -> None:
    lost, mirrored = np.eye(4), np.diag([1.0, 1.0, -1.0, 1.0])
    far = np.eye(4)
    lost[0, 3], far[0, 3] = np.nan, 500.0
    for T, fault in ((lost, "its matrix holds NaN or infinity"), (mirrored, "not a rotation"), (far, "divide millimetres")):
        with pytest.raises(OptionError, match=f"T_world_object is no pose of 'can'.*{fault}"):
            plan(robot, dro.load_object("can"), T)


@pytest.mark.parametrize(("options", "said"), BAD.values(), ids=BAD)
def test_bad_input_is_refused_in_words_and_nothing_is_written(
    options: list[str], said: str, small_robot: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    low, squashed = np.eye(4), np.diag([1.0, 2.0, 1.0, 1.0])
    low[:3, 3] = 0.5, 0.0, -1.0
    Path("low.json").write_text(json.dumps({"frame": "world", "T_frame_object": low.tolist()}))
    Path("squashed.json").write_text(json.dumps({"frame": "world", "T_frame_camera": squashed.tolist()}))
    before = sorted(tmp_path.iterdir())
    assert main(["plan", "--robot", small_robot, "--object", "can", "--output", "plan.npz", *options]) == 2
    assert said in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(("option", "said"), [("robot.yaml", "link 'link9', which the arm does not have"),
                                              (None, "too large for a hand to grasp; if it is a camera's view")])
def test_a_robot_and_a_cloud_that_cannot_be_used_leave_nothing_behind(
    option: str | None, said: str, small_robot: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    text = (BUILTIN_ROBOTS / "xarm7_leaphand.yaml").read_text()
    Path("robot.yaml").write_text(text.replace("link: link7", "link: link9").replace("arm: ", f"arm: {BUILTIN_ROBOTS}/"))
    x, y = np.meshgrid(np.linspace(0, 0.9, 90), np.linspace(-0.6, 0.6, 120))
    np.save("table.npy", np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3))
    before = sorted(tmp_path.iterdir())
    given = ["--robot", option or small_robot, "--object", "table.npy"]
    assert main(["plan", *given, "--output", "plan.npz", "--csv", "plan.csv"]) == 2
    assert said in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == before


def test_without_the_extra_planning_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "ompl", None)
    assert main(["plan", "--robot", "xarm7_leaphand", "--object", "can"]) == 2
    assert "ompl; run pip install 'dro-grasp[arm]', or pip install '.[arm]' in the folder of" in capsys.readouterr().err


def test_every_other_command_works_without_the_extra(small_robot: str) -> None:
    blocked = "".join(f"sys.modules[{name!r}] = None; " for name in EXTRAS["arm"])
    code = (f"import sys; {blocked}import dro_grasp as dro; from dro_grasp.cli.main import main; "
            f"dro.PlanConfig, dro.MotionPlan.load; sys.exit(main(['robot', 'check', {small_robot!r}]))")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_robot_file_without_a_table_has_the_ground_for_one(
    small_robot: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An object at `--at` stands on something: the hand must not pass below its foot."""
    values = yaml.safe_load(Path(small_robot).read_text())
    del values["table"]
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump(values))
    output = tmp_path / "plan.npz"
    command = ["plan", "--robot", str(tmp_path / "robot.yaml"), "--object", "can", "--output", str(output)]
    assert main([*command, "--at", "0.5", "0.1", "--num", "8", "--rehearsals", "0"]) == 0
    said = capsys.readouterr().err
    assert "states no table: z = 0 is taken for one" in said
    made, robot = MotionPlan.load(output), dro.load_robot(small_robot)
    assert made.notes.table == 0.0
    assert made.notes.robot_file == str(tmp_path / "robot.yaml")
    wrist = torch.from_numpy(robot.T_world_wrist(made.arm.position)).float()
    assert float(robot.hand.points(torch.from_numpy(made.hand.position).float(), wrist)[..., 2].min()) > 0


@pytest.fixture(scope="module")
def grasped(robot: dro.Robot, standing: tuple[dro.ObjectModel, np.ndarray]) -> dro.GraspBatch:
    """Grasps of the standing can in the world, which cost no time."""
    obj, T = standing
    made = dro.GraspPredictor().predict(robot.hand, obj, 8, seed=0, source="optimiser", candidates=1, table=float(-T[2, 3]))
    return made.replace(T_object_wrist=torch.from_numpy(T).float() @ made.T_object_wrist, extra={})


def test_a_plan_begins_where_the_arm_is(
    robot: dro.Robot, standing: tuple[dro.ObjectModel, np.ndarray], grasped: dro.GraspBatch
) -> None:
    config = PlanConfig(rehearsals=0)
    aside = torch.from_numpy(robot.home + 0.3 * np.sign(robot.home.mean() - robot.home))
    starts = [robot.home, aside, [*robot.home[:-1], robot.home[-1] + 1.0]]
    for start in starts:
        made = plan(robot, *standing, config=config, grasps=grasped, start=start)
        np.testing.assert_allclose(made.arm.position[0], start, atol=1e-9)
        assert made.arm.velocity[0] == pytest.approx(0.0)
    np.testing.assert_array_equal(plan(robot, *standing, config=config, grasps=grasped).arm.position[0], robot.home)


@pytest.mark.parametrize(("change", "told"), [
    (lambda q, robot: q[:-1], r"start has \d values; robot '.*' has \d arm joints: "),
    (lambda q, robot: [*q, 0.0], r"start has \d values"),
    (lambda q, robot: np.array([*q[:-1], robot.upper[-1] + 0.01]), r"start puts joint '.*' at .*, outside its limits .* to"),
    (lambda q, robot: np.array([np.nan, *q[1:]]), r"start puts joint '.*' at nan, outside its limits"),
    (lambda q, robot: np.rad2deg(q) + 100, r"outside its limits .* give radians"),
])
def test_a_start_that_the_arm_cannot_have_is_refused(
    change: Any, told: str, robot: dro.Robot, standing: tuple[dro.ObjectModel, np.ndarray], grasped: dro.GraspBatch
) -> None:
    with pytest.raises(OptionError, match=told):
        plan(robot, *standing, grasps=grasped, start=change(robot.home, robot))


def test_a_start_in_the_table_is_refused(
    robot: dro.Robot, standing: tuple[dro.ObjectModel, np.ndarray], grasped: dro.GraspBatch
) -> None:
    """The lowest of many configurations, by kinematics alone."""
    lower, upper = robot.working_range
    draws = np.random.default_rng(0).uniform(lower, upper, (4000, len(lower)))
    lowest = draws[robot.T_world_wrist(draws)[:, 2, 3].argmin()]
    assert robot.T_world_wrist(lowest)[2, 3] < -0.1
    with pytest.raises(RobotError, match=r"collides at the start: .*begin elsewhere \(start="):
        plan(robot, *standing, grasps=grasped, start=lowest)


def lowest_above(robot: dro.Robot, made: MotionPlan, centre: np.ndarray, half: float) -> float:
    """Lowest corner of any shape of hand or moving arm over a square in the world, during the whole motion [m].

    Shapes as they are drawn, placed by MuJoCo, which knows nothing of the planner's scene.
    """
    scene = robot_spec(robot, PROTOCOLS["dro"], None)
    model = scene.compile()
    data = mujoco.MjData(model)
    (fingers, moving), tree = joint_addresses(model, robot.hand), robot.hand.tree
    _, _, arm, hand = finer(made)
    full = hand @ tree.coupling.double().numpy().T + tree.offset.double().numpy()
    lowest = np.inf
    shapes = [(f"arm/{robot.arm.tree.link_names[s.link]}", s.vertices) for s in robot.arm.geometry if s.link > 0]
    assert robot.hand.description is not None
    shapes += [(f"hand/{robot.hand.tree.link_names[s.link]}", s.vertices) for s in robot.hand.description.geometry]
    bodies = {model.body(i).name for i in range(model.nbody)}
    shapes = [(name, vertices) for name, vertices in shapes if name in bodies]
    assert any(name.startswith("hand/") for name, _ in shapes)
    for q, joints in zip(arm[::5], full[::5, moving], strict=True):
        data.qpos[arm_addresses(model, robot)], data.qpos[fingers] = q, joints
        mujoco.mj_kinematics(model, data)
        for name, vertices in shapes:
            body = data.body(name)
            points = vertices @ body.xmat.reshape(3, 3).T + body.xpos
            inside = (np.abs(points[:, :2] - centre) < half).all(1)
            lowest = min(lowest, float(points[inside, 2].min(initial=np.inf)))
    return lowest


@pytest.mark.slow
@pytest.mark.parametrize("named", ["xarm7_leaphand", "ur5e_allegro", "small"])
@pytest.mark.parametrize(("name", "turn", "height"), [("can", 0.0, 0.0), ("can", np.pi / 2, 0.0), ("mug", 0.0, 0.12)])
@pytest.mark.parametrize("stated", [True, False], ids=["table", "no table"])
def test_no_plan_passes_what_the_object_stands_on(
    named: str, name: str, turn: float, height: float, stated: bool, small_robot: str
) -> None:
    """Several arms and hands, poses and heights, with and without a table in the robot file."""
    robot, obj, T = dro.load_robot(small_robot if named == "small" else named), dro.load_object(name), np.eye(4)
    T[1:3, 1:3] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    T[:3, 3] = 0.5, 0.1, height - float((obj.cloud @ T[2, :3]).min())
    table = dro_robot.Table(height, (0.55, 0.1), (0.6, 0.6)) if stated else None
    robot = replace(robot, table=table, camera=None)
    made = plan(robot, obj, T, config=PlanConfig(num=8, rehearsals=0), seed=1)
    assert made.notes.table == pytest.approx(height, abs=1e-4)
    assert lowest_above(robot, made, np.array([0.5, 0.1]), 0.2) > height - 1e-3


def test_grasps_below_the_foot_of_an_object_are_refused_without_a_table_as_with_one(
    robot: dro.Robot, standing: tuple[dro.ObjectModel, np.ndarray]
) -> None:
    obj, T = standing
    made = dro.GraspPredictor().predict(robot.hand, obj, 24, seed=0, source="optimiser", candidates=1, direction=(1, 0, 0),
                                        max_tilt=0.8, least_confidence=0.0)
    placed = made.replace(T_object_wrist=torch.from_numpy(T).float() @ made.T_object_wrist, extra={})
    lowest = robot.hand.points(placed.joints, placed.T_object_wrist)[..., 2].amin(1)
    low = placed[lowest < -0.015]
    assert len(low) >= 3
    assert robot.table is not None
    for table in (None, robot.table):
        with pytest.raises(PlanError, match="and none is left for 'can'"):
            plan(replace(robot, table=table), obj, T, grasps=low, config=PlanConfig(rehearsals=0))
