"""Plans: collision-free at ten times their resolution, within limits, straight where they should be, and refused in words."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import trimesh
import yaml

import dro_grasp as dro
from dro_grasp.errors import PlanError, RobotError
from dro_grasp.planning import planner
from dro_grasp.planning.collisions import CollisionChecker
from dro_grasp.planning.motion import STAGES, MotionPlan
from dro_grasp.planning.plan_config import PlanConfig
from dro_grasp.planning.planner import plan
from dro_grasp.planning.reachability import Feasible, Postures
from dro_grasp.planning.timed_stages import timed_stages
from dro_grasp.planning.timing import STEP, Trajectory, standing as standing_still
from dro_grasp.planning.workcell import arm_addresses, robot_spec
from dro_grasp.simulation.hand_part import joint_addresses
from dro_grasp.simulation.protocols import PROTOCOLS

FINER = 10
PLACE = (0.5, 0.1)


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> dro.ObjectModel:
    """A board between the home position and the object."""
    board = trimesh.creation.box(extents=(0.02, 0.2, 0.3))
    board.apply_translation((0.33, 0.1, 0.16))
    path = tmp_path_factory.mktemp("wall") / "wall.obj"
    board.export(path)
    return dro.load_object(str(path))


@pytest.fixture(scope="module")
def standing() -> tuple[dro.ObjectModel, np.ndarray]:
    obj, T = dro.load_object("can"), np.eye(4)
    T[:3, 3] = *PLACE, -float(obj.cloud[:, 2].min())
    return obj, T


@pytest.fixture(scope="module")
def planned(robot: dro.Robot, wall: dro.ObjectModel, standing: tuple[dro.ObjectModel, np.ndarray]) -> MotionPlan:
    return plan(robot, *standing, obstacles=[wall], config=PlanConfig(num=12), seed=0)


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
    for a, b in CollisionChecker(robot, robot.table).excluded:
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


def test_the_check_above_sees_a_plan_that_goes_through_the_wall(
    robot: dro.Robot, wall: dro.ObjectModel, standing: tuple[dro.ObjectModel, np.ndarray], planned: MotionPlan
) -> None:
    goal = planned.arm.position[planned.part("shape")][0]
    straight = np.linspace(robot.home, goal, 200)
    opened = torch.from_numpy(planned.hand.position[0]).float().expand(200, -1)
    points = robot.hand.points(opened, torch.from_numpy(robot.T_world_wrist(straight)).float())
    checker = CollisionChecker(robot, robot.table, [wall], *standing)
    free = [checker.free(q, planned.hand.position[0], 0.0) for q in straight]
    inside = wall.distance_field.distances(points)[0].amin(-1) < -0.003
    assert not any(f and bool(i) for f, i in zip(free, inside, strict=True))


def test_a_carried_object_hits_obstacles_and_leaves_the_table_in_peace(robot: dro.Robot, wall: dro.ObjectModel) -> None:
    can, T = dro.load_object("can"), np.eye(4)
    T[:3, 3] = 0.5, 0.1, -float(can.cloud[:, 2].min()) - 0.001
    checker, up = CollisionChecker(robot, robot.table, [wall], can, T), np.eye(4)
    fingers = robot.hand.canonical_joints().double().numpy()
    assert checker.free(robot.home, fingers, moved=up, touch=True)
    up[:3, 3] = -0.17, 0.0, 0.05
    assert {(c.first, c.second) for c in checker.contacts(robot.home, fingers, 0.0, up, touch=True)} <= {
        ("obstacle", "target"), ("target", "obstacle")}
    assert not checker.free(robot.home, fingers, moved=up, touch=True)
    up[:3, 3] = 0, 0, -0.02
    assert not checker.free(robot.home, fingers, moved=up, touch=True)


def test_limits_hold_by_finite_differences(planned: MotionPlan, robot: dro.Robot) -> None:
    n = len(planned.notes.hand_joints)
    limits = [(planned.arm, robot.velocity, robot.acceleration),
              (planned.hand, np.full(n, robot.hand_velocity), np.full(n, robot.hand_acceleration))]
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


def test_what_was_dropped_adds_up(planned: MotionPlan) -> None:
    notes = planned.notes
    assert notes.goals >= 1
    assert sum(notes.dropped.values()) + notes.goals <= notes.grasps == 12
    assert planned.lines()[0].startswith("12 grasps: ")


def test_a_plan_file_gives_the_plan_back_and_other_files_are_refused(planned: MotionPlan, tmp_path: Path) -> None:
    path = tmp_path / "plan.npz"
    planned.save(path)
    again = MotionPlan.load(path)
    assert again.notes == planned.notes
    assert (again.hand.velocity == planned.hand.velocity).all()
    assert again.lines() == planned.lines()
    (tmp_path / "half.npz").write_bytes(path.read_bytes()[:5000])
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    for name in ("half.npz", "other.npz", "none.npz"):
        with pytest.raises(PlanError, match=f"{name} cannot be read .* expected a plan file"):
            MotionPlan.load(tmp_path / name)


@pytest.mark.parametrize(("change", "told"), [
    (lambda header: [], "cannot be read .*expected a plan file"), (lambda header: 3, "cannot be read .*expected a plan file"),
    (lambda header: {k: v for k, v in header.items() if k != "arm_joints"}, "'arm_joints'"),
    (lambda header: {k: v for k, v in header.items() if k != "seed"}, "'seed'"),
    (lambda header: header | {"unknown": 1}, "'unknown'"), (lambda header: header | {"hand_joints": 3}, "'int'"),
    (lambda header: header | {"format_version": 1}, "another version; plan again"), (lambda header: {}, "another version"),
], ids=["list", "number", "no arm_joints", "no seed", "unknown entry", "joints of no list", "version 1", "empty"])
def test_a_plan_file_with_another_header_is_refused(
    planned: MotionPlan, tmp_path: Path, change: Callable[[dict[str, Any]], Any], told: str
) -> None:
    planned.save(tmp_path / "plan.npz")
    with np.load(tmp_path / "plan.npz") as file:
        arrays = dict(file)
    arrays["header"] = np.array(json.dumps(change(json.loads(str(arrays["header"])))))
    np.savez(tmp_path / "changed.npz", **arrays)
    with pytest.raises(PlanError, match=rf"changed\.npz .*{told}"):
        MotionPlan.load(tmp_path / "changed.npz")


def test_drivers_get_every_target_and_controllers_the_same_motion(planned: MotionPlan) -> None:
    points = list(planned.points(rate=50))
    assert len(points) == int(np.ceil(planned.seconds * 50)) + 1
    assert [p.stage for p in points][0::len(points) - 1] == ["reach", "lift"]
    assert np.allclose(points[-1].arm, planned.arm.position[-1])
    messages = yaml.load(dro.trajectory_yaml(planned), yaml.CSafeLoader)
    assert messages["arm"]["joint_names"] == list(planned.notes.arm_joints)
    last = messages["hand"]["points"][-1]
    assert np.allclose(last["positions"], planned.hand.position[-1], atol=1e-6)
    end = last["time_from_start"]
    assert end["sec"] + 1e-9 * end["nanosec"] == pytest.approx(planned.seconds, abs=1e-6)
    late = replace(planned, arm=replace(planned.arm, time=planned.arm.time - planned.arm.time[-1] + 2 - 4e-10))
    stamps = [p["time_from_start"] for p in yaml.load(dro.trajectory_yaml(late), yaml.CSafeLoader)["arm"]["points"]]
    assert stamps[-1] == {"sec": 2, "nanosec": 0}, "a second has 10^9 nanoseconds, not one more"
    rows = list(csv.DictReader(io.StringIO(dro.trajectory_csv(planned))))
    assert len(rows) == len(planned.stage)
    assert float(rows[-1]["arm/joint1"]) == pytest.approx(planned.arm.position[-1, 0], abs=1e-6)


def test_samples_are_at_most_a_step_apart(planned: MotionPlan) -> None:
    assert np.diff(planned.arm.time).max() < STEP + 1e-9
    for seconds, count in ((0.0149, 3), (0.5, 51), (0.0, 1)):
        assert len(standing_still(np.zeros(2), seconds).time) == count


@pytest.mark.parametrize("still", ["shape", "approach", "lift"])
def test_a_stage_in_which_nothing_moves_is_a_stage(robot: dro.Robot, planned: MotionPlan, still: str) -> None:
    """As when the pregrasp is the posture in which the hand travels."""
    opened = robot.hand.canonical_joints().double().numpy()
    bent, turned = opened + (still != "shape") * 0.05 * robot.hand.opening_signs.double().numpy(), np.eye(7)[0]
    approach, lift = (np.linspace(robot.home + a * turned, robot.home + b * turned, 5) for a, b in (
        (0.1, 0.1 if still == "approach" else 0.15), (0.15, 0.15 if still == "lift" else 0.2)))
    made = timed_stages(robot, CollisionChecker(robot), np.stack([robot.home, approach[0]]), Feasible(0, approach, lift),
                        Postures(opened, bent, opened, opened), PlanConfig())
    assert made is not None
    whole = replace(planned, stage=made.stage, arm=made.arm, hand=made.hand)
    assert f"{still} 0.0 s" in whole.lines()[2]
    assert (np.diff(whole.arm.time) > 0).all()
    assert sorted(set(made.stage.tolist())) == list(range(len(STAGES)))
    assert all(np.ptp(whole.arm.position[whole.part(s)], axis=0).max() > 0 for s in ("reach", "approach", "lift") if s != still)


def test_a_plan_file_in_which_a_stage_has_no_rows_is_read(planned: MotionPlan) -> None:
    """As they were written before."""
    rows = planned.stage != STAGES.index("shape")
    arm, hand = (Trajectory(t.time[rows], t.position[rows], t.velocity[rows], t.acceleration[rows])
                 for t in (planned.arm, planned.hand))
    old = replace(planned, stage=planned.stage[rows], arm=arm, hand=hand)
    assert "shape 0.0 s" in old.lines()[2]
    assert old.part("shape") == slice(old.part("reach").stop - 1, old.part("reach").stop)


def test_what_touches_the_robot_at_home_is_named(
    robot: dro.Robot, wall: dro.ObjectModel, standing: tuple[dro.ObjectModel, np.ndarray]
) -> None:
    can, T = standing
    elbow = trimesh.creation.box((0.2, 0.2, 0.2), trimesh.transformations.translation_matrix((0.0, 0.0, 0.3)))
    seen = dro.load_scene(trimesh.sample.sample_surface(elbow, 2000, seed=0)[0])
    config = PlanConfig(constraints=dro.Constraints(avoid=replace(seen, name="cell")))
    with pytest.raises(PlanError, match=r"obstacle 'cell' collides with arm/link\d .* by .* mm; cut the robot out of"):
        plan(robot, can, T, [wall], config=config)
    assert robot.table is not None
    raised = replace(robot, table=replace(robot.table, height=robot.T_world_wrist(robot.home)[2, 3]))
    with pytest.raises(RobotError, match=r"(arm|hand)/\w+ and table, by .* mm; correct `table` in the robot file"):
        plan(raised, can, trimesh.transformations.translation_matrix((0.5, 0.1, 0.6)), [wall])


def test_each_batch_of_grasps_is_another_one(
    robot: dro.Robot, standing: tuple[dro.ObjectModel, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []

    def nowhere(predictor: object, hand: dro.Hand, obj: dro.ObjectModel, T: object, num: int, *rest: object) -> dro.GraspBatch:
        asked.append(int(str(rest[-1])))
        away = torch.eye(4).repeat(num, 1, 1)
        away[:, 2, 3] = 9.0
        q = hand.canonical_joints().repeat(num, 1)
        return dro.GraspBatch.create(hand, obj, away, q, score=torch.zeros(num), pregrasp_joints=q, squeeze_joints=q)

    monkeypatch.setattr(planner, "grasps_in_world", nowhere)
    with pytest.raises(PlanError, match="6 grasps: 6 out of reach"):
        plan(robot, *standing, config=PlanConfig(num=2, batches=3), seed=7)
    assert asked[0] == 7
    assert len(set(asked)) == 3
