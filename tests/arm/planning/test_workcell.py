"""What collides in a workcell, and that each of its models is compiled once."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
import trimesh
import yaml
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import dro_grasp as dro
from dro_grasp.arm.planning.candidates import grasps_in_world
from dro_grasp.arm.planning.physics import LiftScene
from dro_grasp.arm.planning.reachability import WristSolver
from dro_grasp.arm.planning.task import PlanConfig, Task
from dro_grasp.arm.planning.workcell import TABLE, VOXEL, Workcell, occupied, scene_solid
from dro_grasp.arm.robot_check import check_robot
from dro_grasp.arm.robots.loading import load_robot
from dro_grasp.cli.main import main
from dro_grasp.errors import PlanError, RobotError
from dro_grasp.optimize.grasp_energy import PRESSED


def test_boxes_of_a_cloud_fill_its_cells_and_nothing_else() -> None:
    points = np.random.default_rng(0).uniform(0, 0.06, (300, 3))
    centre, half = occupied(points)
    cells = np.unique(np.floor(points / VOXEL).astype(int), axis=0)
    assert (2 * half).prod(1).sum() == pytest.approx(len(cells) * VOXEL**3)
    beyond = (np.abs(points[:, None] - centre) - half).max(-1)
    assert beyond.min(1).max() < 1e-9


def test_boxes_of_a_plate_are_one() -> None:
    x, y = np.meshgrid(np.arange(0.005, 0.3, 0.01), np.arange(0.005, 0.2, 0.01))
    centre, half = occupied(np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.005)]))
    np.testing.assert_allclose(centre, [[0.15, 0.1, 0.005]])
    np.testing.assert_allclose(half, [[0.15, 0.1, 0.005]])


SHELF = ((0.62, 0.1, 0.5), (0.02, 2.0, 2.0))
"""Centre and size of a board beside the object, larger than any object that is loaded [m]."""


def test_a_mesh_of_any_size_is_solid_where_the_robot_gets(robot: dro.Robot) -> None:
    board = trimesh.creation.box(extents=SHELF[1])
    board.apply_translation(SHELF[0])
    avoid = dro.load_scene(board)
    base, reach = robot.T_world_base[:3, 3], robot.longest_reach
    (thing,) = scene_solid(avoid, base, reach)
    assert np.linalg.norm(thing.cloud - base, axis=1).max() <= reach
    draw = np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3)) * SHELF[1] + SHELF[0]
    draw[:, 0] = SHELF[0][0] - SHELF[1][0] / 2
    near = draw[np.linalg.norm(draw - base, axis=1) < reach - 0.02]
    assert KDTree(thing.cloud).query(near)[0].max() < 0.01, "no hole in its face [m]"
    assert scene_solid(avoid, np.array([50.0, 0, 0]), reach) == []


def test_an_arm_that_dips_into_the_table_collides_with_it_and_with_nothing_else(small_robot: str) -> None:
    robot = load_robot(small_robot)
    down = robot.home.copy()
    down[[1, 3]] = 1.2, 1.6
    found = Workcell(robot).contacts(down, robot.open_hand)
    assert found
    assert {"table"} == {name for c in found for name in (c.first, c.second) if "/" not in name}
    assert not Workcell(replace(robot, table=None)).contacts(down, robot.open_hand)


def lowered(robot: dro.Robot, depth: float) -> np.ndarray:
    """The arm with the palm facing down and the lowest link of the open hand so deep in the table [m]."""
    cell, solver = Workcell(robot), WristSolver(Workcell(robot))
    assert robot.table is not None
    palm = robot.hand.palm_direction_wrist.double().numpy()
    T = np.eye(4)
    T[:3, :3] = Rotation.align_vectors([[0, 0, -1]], [palm])[0].as_matrix()
    low = float((robot.hand.points(torch.from_numpy(robot.open_hand).float()).double().numpy() @ T[:3, :3].T)[:, 2].min())
    T[:3, 3] = 0.5, 0.0, robot.table.height - 0.01 - low
    for _ in range(2):  # the surface of the shapes is not quite where points are
        q = solver.solve(T, [robot.home])
        assert q is not None
        T[2, 3] -= depth + min(contact.distance for contact in cell.contacts(q, robot.open_hand))
    return solver.solve(T, [q])


def test_a_squeeze_may_aim_into_the_table_but_not_a_hand_be_there(robot: dro.Robot, wall: dro.ObjectModel) -> None:
    """Nor may it aim deeper than PRESSED, or into an obstacle."""
    shallow, deep = lowered(robot, 0.01), lowered(robot, PRESSED + 0.002)
    cell = Workcell(robot)
    assert {name for c in cell.contacts(shallow, robot.open_hand) for name in (c.first, c.second) if "/" not in name} == {TABLE}
    assert not cell.free(shallow, robot.open_hand)
    assert cell.free(shallow, robot.open_hand, aimed=True)
    assert not cell.free(deep, robot.open_hand, aimed=True)
    beside = wall.cloud - wall.cloud.mean(0) + robot.hand.points(
        torch.from_numpy(robot.open_hand).float(), torch.from_numpy(robot.T_world_wrist(shallow)).float()).mean(0).numpy()
    obstacle = dro.load_object(beside, keep_table=True)
    assert not Workcell(robot, [obstacle]).free(shallow, robot.open_hand, aimed=True)


@pytest.mark.parametrize(("high", "low"), [(0.034, True), (0.036, False)])
def test_fingertips_may_touch_the_table_beside_what_is_low(robot: dro.Robot, high: float, low: bool) -> None:
    """As where grasps are made; else such grasps would all be dropped."""
    obj, T = dro.load_object(trimesh.creation.box(extents=(0.05, 0.05, high))), np.eye(4)
    T[:3, 3] = 0.5, 0.1, high / 2
    task = Task.of(robot, obj, T, (), PlanConfig(), 0)
    assert (task.reach.config.table_margin, task.reach.config.clearance) == ((-0.001, 0.0) if low else (0.002, 0.001))
    asked = Task.of(robot, obj, T, (), PlanConfig(constraints=dro.Constraints(touch_table=not low)), 0)
    assert asked.touches_table == (not low)


def test_a_carried_object_hits_obstacles_and_leaves_the_table_in_peace(robot: dro.Robot, wall: dro.ObjectModel) -> None:
    can, T = dro.load_object("can"), np.eye(4)
    T[:3, 3] = 0.5, 0.1, -float(can.cloud[:, 2].min()) - 0.001
    cell, up = Workcell(robot, [wall], can, T), np.eye(4)
    fingers = robot.hand.canonical_joints().double().numpy()
    assert cell.free(robot.home, fingers, moved=up, touch=True)
    up[:3, 3] = -0.17, 0.0, 0.05
    assert {(c.first, c.second) for c in cell.contacts(robot.home, fingers, 0.0, up, touch=True)} <= {
        ("obstacle", "target"), ("target", "obstacle")}
    assert not cell.free(robot.home, fingers, moved=up, touch=True)
    up[:3, 3] = 0, 0, -0.02
    assert not cell.free(robot.home, fingers, moved=up, touch=True)


def test_each_model_of_a_robot_is_compiled_once(compiled: list[mujoco.MjSpec]) -> None:
    robot, can = load_robot("xarm7_leaphand"), dro.load_object("can")  # read before: their own models are compiled
    robot = replace(robot, home=robot.home + 1e-3)  # no other test has it
    place, config = np.array([0.5, 0.1, -float(can.cloud[:, 2].min())]), PlanConfig(num=4, rehearsals=1, batches=1)
    T = np.eye(4)
    T[:3, 3] = place
    request = dro.GraspRequest(4, candidates=1)
    grasps = grasps_in_world(dro.GraspPredictor(), robot.hand, can, T, request, dro.Constraints(table=0.0))
    compiled.clear()
    dro.plan(robot, can, T, config=config, grasps=grasps)
    assert len(compiled) == 4, "the arm, the robot alone, the workcell, and the rehearsal"
    compiled.clear()
    dro.plan(replace(robot, table=replace(robot.table, height=-0.001), camera=None), can, T, config=config, grasps=grasps)
    assert len(compiled) == 2, "a table that was seen elsewhere makes no other robot"


FOOT = """<mujoco><compiler angle="radian"/><worldbody><body name="base"><geom type="cylinder" size="0.08 0.01" pos="0 0 0.01"/>
<body name="foot"><joint name="pan" axis="0 0 1" range="-3 3"/><geom type="cylinder" size="0.06 0.05" pos="0 0 0.05"/>
<body name="upper" pos="0 0 0.15"><joint name="lift" axis="0 1 0" range="-0.5 0.5"/>
<geom type="box" pos="0 0 0.15" size="0.03 0.03 0.15"/>
<body name="tip" pos="0 0 0.35"><joint name="bend" axis="0 1 0" range="-0.5 0.5"/><geom size="0.03"/></body></body></body>
</body></worldbody></mujoco>"""
"""An arm whose foot turns on what it stands on."""


def standing_arm(folder: Path, **values: Any) -> Path:
    (folder / "arm.xml").write_text(FOOT)
    stated = {"arm": "arm.xml", "hand": "gripper3", "mount": {"link": "tip", "position": [0, 0, 0.06]},
              "home": {"pan": 0.0, "lift": 0.1, "bend": 0.1}, "limits": {"velocity": 1.0, "acceleration": 4.0}, "table": {}}
    (folder / "robot.yaml").write_text(yaml.safe_dump(stated | values))
    return folder / "robot.yaml"


@pytest.mark.parametrize("height", [0.0, 0.004, -0.002], ids=["on it", "in it", "just above it"])
def test_a_foot_that_turns_on_the_table_is_not_checked_against_it(height: float, tmp_path: Path) -> None:
    """Neither the base nor the foot can get off the table; the arm above them can fall on it, and is checked."""
    report = check_robot(standing_arm(tmp_path, table={"height": height}))
    assert ("arm/foot", "world") in report.excluded
    assert report.usable
    assert report.free_share > 0.5
    assert any("foot and table" in line for line in report.lines() if line.startswith("not checked"))
    assert not Workcell(load_robot(tmp_path / "robot.yaml")).contacts(np.array([1.0, 0.1, 0.1]), report.robot.open_hand)
    scene = LiftScene(Workcell(report.robot), [])
    touching = {scene.model.body(b).name for b in scene.model.geom_bodyid[scene.data.contact.geom].ravel()}
    assert "arm/foot" not in touching


def test_a_robot_that_is_nowhere_free_is_not_usable_and_what_collides_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = standing_arm(tmp_path, table={"height": 0.24})
    assert main(["robot", "check", str(file)]) == 2
    said = capsys.readouterr().out
    assert "0% of random configurations" in said
    assert "COLLISION everywhere: " in said
    assert "and arm/upper, in 100%" in said or "arm/upper and table, in 100%" in said or "table and arm/upper, in 100%" in said
    assert "not usable" in said
    T = np.eye(4)
    T[:3, 3] = 0.3, 0.0, 0.3
    with pytest.raises(RobotError, match=r"collides at home: arm/upper and table, by .* mm; correct `table`"):
        dro.plan(load_robot(file), dro.load_object("can"), T)


def test_a_home_that_is_nearer_than_is_kept_is_refused(robot: dro.Robot) -> None:
    """The planner starts from no such place, so that no advice about the object would help."""
    wrist = torch.from_numpy(robot.T_world_wrist(robot.home)).float()
    points = robot.hand.points(robot.hand.canonical_joints(), wrist).double().numpy()
    below = trimesh.creation.box((0.05, 0.05, 0.05))
    below.apply_translation(points[points[:, 2].argmin()] - (0, 0, 0.025 + 0.003))
    can, T = dro.load_object("can"), np.eye(4)
    T[:3, 3] = 0.5, 0.3, -float(can.cloud[:, 2].min())
    with pytest.raises(PlanError, match=r"collides with hand/\w+ while .* at home, [234]\.\d mm apart, where 5 mm are kept"):
        dro.plan(robot, can, T, [replace(dro.load_object(below), name="block")])
