"""Places: where an object may be put, the motion that puts it there, and what becomes of it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

import dro_grasp as dro
from dro_grasp.apps.viewer.lift_page import Film
from dro_grasp.arm.planning.motion import ALL_STAGES, PLACING, STAGES, MotionPlan
from dro_grasp.arm.planning.physics import LiftScene
from dro_grasp.arm.planning.placing import AWAY, SPOTS, TURNS, Place, Placing, foot, off_table, standing_turn
from dro_grasp.arm.planning.planner import plan
from dro_grasp.arm.planning.reachability import Fault, Places, Put, Reachability, ReachConfig
from dro_grasp.arm.planning.task import PlanConfig
from dro_grasp.arm.planning.workcell import CARRIED, Workcell, arm_addresses, robot_spec
from dro_grasp.arm.tabletop.attempts import Attempt
from dro_grasp.arm.tabletop.experiment import TabletopConfig, attempt
from dro_grasp.arm.tabletop.placed import draw_place, measured, place_fault
from dro_grasp.arm.tabletop.table_scene import PickedObject
from dro_grasp.errors import OptionError, PlanError
from dro_grasp.objects.loading import cloud_object
from dro_grasp.simulation.protocols import PROTOCOLS
from dro_grasp.simulation.scene import joint_addresses

Standing = tuple[dro.ObjectModel, np.ndarray]
SPOT, YAW = (0.48, -0.16, 0.0), 0.5
QUICK = TabletopConfig(see="mesh", place=True, plan=PlanConfig(num=8, best_seconds=30, planner_seconds=30))


@pytest.fixture(scope="module")
def placed(robot: dro.Robot, wall: dro.ObjectModel, standing: Standing) -> MotionPlan:
    return plan(robot, *standing, obstacles=[wall], config=PlanConfig(num=12), seed=0, place=(*SPOT, YAW))


def box(path: Path, extents: tuple[float, float, float], at: tuple[float, float, float]) -> dro.ObjectModel:
    solid = trimesh.creation.box(extents=extents)
    solid.apply_translation(at)
    solid.export(path)
    return dro.load_object(str(path))


def object_poses(robot: dro.Robot, made: MotionPlan) -> np.ndarray:
    """Motion of the object in the world at each sample, by the wrist that holds it from the lift to the release."""
    wrist, poses = robot.T_world_wrist(made.arm.position), np.tile(np.eye(4), (len(made.stage), 1, 1))
    held = (made.stage >= ALL_STAGES.index("lift")) & (made.stage <= ALL_STAGES.index("lower"))
    first = int(held.argmax()) - 1
    T_held = np.array(made.notes.T_world_held)
    assert np.linalg.norm((T_held - wrist[first])[:3, 3]) < 0.03  # the object shifts little as the hand closes
    poses[held] = wrist[held] @ np.linalg.inv(T_held)
    poses[made.stage > ALL_STAGES.index("lower")] = poses[held][-1]
    return poses


def test_the_object_ends_on_its_place_and_touches_nothing_on_the_way(
    robot: dro.Robot, placed: MotionPlan, standing: Standing, wall: dro.ObjectModel
) -> None:
    obj, T = standing
    assert placed.stages == (*STAGES, *PLACING)
    assert sorted(set(placed.stage.tolist())) == list(range(len(ALL_STAGES)))
    corners = np.asarray(obj.vertices) @ T[:3, :3].T + T[:3, 3]
    poses = object_poses(robot, placed)
    moved = np.einsum("kij,nj->kni", poses[:, :3, :3], corners) + poses[:, None, :3, 3]
    assert moved[..., 2].min() > -0.002
    assert np.abs(moved[-1].min(0)[:2] + moved[-1].max(0)[:2] - 2 * np.array(SPOT[:2])).max() < 0.003
    assert abs(moved[-1, :, 2].min()) < 0.002
    spoke, end = corners[0] - corners.mean(0), moved[-1, 0] - moved[-1].mean(0)
    turn = math.atan2(end[1], end[0]) - math.atan2(spoke[1], spoke[0])
    assert math.remainder(turn - YAW, 2 * math.pi) == pytest.approx(0, abs=0.01)
    carried = moved[placed.stage == ALL_STAGES.index("carry")].reshape(-1, 3)
    assert float(wall.distance_field.distances(torch.from_numpy(carried).float()[None])[0].min()) > CARRIED / 4


def test_the_robot_touches_neither_table_nor_itself_while_it_places(robot: dro.Robot, placed: MotionPlan) -> None:
    """As plain MuJoCo has them, ten times as often as the plan was checked."""
    scene = robot_spec(robot, PROTOCOLS["dro"], robot.table)
    for a, b in Workcell(robot).excluded:
        scene.add_exclude(bodyname1=a, bodyname2=b)
    model = scene.compile()
    data, ((fingers, moving), tree) = mujoco.MjData(model), (joint_addresses(model, robot.hand), robot.hand.tree)
    rows = placed.stage >= ALL_STAGES.index("carry")
    time = np.linspace(placed.arm.time[rows][0], placed.seconds, 10 * rows.sum())
    arm, hand = (np.stack([np.interp(time, placed.arm.time, c) for c in t.position.T], 1) for t in (placed.arm, placed.hand))
    full = hand @ tree.coupling.double().numpy().T + tree.offset.double().numpy()
    for q, joints in zip(arm[::7], full[::7, moving], strict=True):
        data.qpos[arm_addresses(model, robot)], data.qpos[fingers] = q, joints
        mujoco.mj_fwdPosition(model, data)
        pairs = [sorted(model.body(model.geom_bodyid[g]).name for g in c.geom) for c in data.contact if c.dist < 0]
        assert all(a.startswith("hand/") and b.startswith("hand/") for a, b in pairs), pairs


def test_the_hand_lets_go_goes_straight_back_and_ends_open(robot: dro.Robot, placed: MotionPlan) -> None:
    release, retreat = placed.part("release"), placed.part("retreat")
    assert np.ptp(placed.arm.position[release], axis=0).max() < 1e-9
    np.testing.assert_allclose(placed.hand.position[release][0], placed.squeeze)
    wrist = torch.from_numpy(robot.T_world_wrist(placed.arm.position[retreat])).float()
    way = wrist[-1, :3, 3] - wrist[0, :3, 3]
    ahead = robot.hand.palm_directions(wrist[:1])[0]
    assert float(way @ ahead) == pytest.approx(-ReachConfig().standoff, abs=2e-3)
    assert float((wrist[:, :3, 3] - wrist[0, :3, 3]).sub(((wrist[:, :3, 3] - wrist[0, :3, 3]) @ ahead)[:, None] * ahead).norm(
        dim=1).max()) < 2e-3
    np.testing.assert_allclose(placed.hand.position[-1], robot.open_hand, atol=1e-6)


def test_efforts_end_with_the_release_and_files_keep_the_stages(
    robot: dro.Robot, placed: MotionPlan, tmp_path: Path
) -> None:
    torque = np.linspace(0.1, 0.4, len(placed.notes.hand_joints))
    pressing = replace(placed, notes=replace(placed.notes, squeeze_torque=tuple(torque.tolist())))
    effort = pressing.hand_effort
    assert effort is not None
    lift, carry, release, retreat = (placed.stage == ALL_STAGES.index(s) for s in ("lift", "carry", "release", "retreat"))
    np.testing.assert_allclose(effort[lift | carry], np.tile(torque, ((lift | carry).sum(), 1)))
    assert (np.diff(effort[release][:, 0]) <= 1e-9).all()
    assert np.abs(effort[release][-1]).max() < 1e-9
    assert (effort[retreat] == 0).all()
    pressing.save(tmp_path / "plan.npz")
    again = MotionPlan.load(tmp_path / "plan.npz")
    assert (again.notes, again.stages) == (pressing.notes, ALL_STAGES)
    assert f"put at ({SPOT[0]:.3f}, {SPOT[1]:.3f}" in again.lines()[2]
    assert f"turned by {math.degrees(YAW):.0f} degrees" in again.lines()[2]
    assert "lifts and places object 'can'" in dro.trajectory_yaml(again)
    assert {row.split(",")[1] for row in dro.trajectory_csv(again).splitlines()[1:]} == set(ALL_STAGES)
    assert list(again.points(20))[-1].stage == "retreat"
    film = Film.of_plan(robot, again)
    np.testing.assert_allclose(film.poses[-1, 0], np.array(placed.notes.place), atol=2e-3)
    np.testing.assert_allclose(film.poses[0, 0], np.eye(4))


def test_plan_files_of_before_are_read(planned: MotionPlan, tmp_path: Path) -> None:
    planned.save(tmp_path / "new.npz")
    with np.load(tmp_path / "new.npz") as file:
        arrays = dict(file)
    header = json.loads(str(arrays["header"]))
    del header["place"]
    for version, is_read in ((2, True), (1, False)):
        old: dict[str, Any] = arrays | {"header": np.array(json.dumps(header | {"format_version": version}))}
        np.savez(tmp_path / "old.npz", **old)
        if is_read:
            assert MotionPlan.load(tmp_path / "old.npz").stages == STAGES
        else:
            with pytest.raises(PlanError, match="of another version; plan again"):
                MotionPlan.load(tmp_path / "old.npz")


@pytest.mark.parametrize("tilt", [0.0, 0.3, 0.7, 1.2])
def test_a_mesh_is_put_on_its_nearest_face_and_a_cloud_as_it_stood(tmp_path: Path, tilt: float) -> None:
    """A cube that is tilted by less than half a right angle about x goes back, and by more on to the next face."""
    cube, T = box(tmp_path / "cube.obj", (0.06, 0.06, 0.06), (0, 0, 0)), np.eye(4)
    T[1:3, 1:3] = [[math.cos(tilt), -math.sin(tilt)], [math.sin(tilt), math.cos(tilt)]]
    turn = standing_turn(cube, T)
    expected = -tilt if tilt < math.pi / 4 else math.pi / 2 - tilt
    np.testing.assert_allclose(turn[1:, 1:], [[math.cos(expected), -math.sin(expected)],
                                              [math.sin(expected), math.cos(expected)]], atol=1e-6)
    assert turn[0, 0] == pytest.approx(1)
    assert np.array_equal(standing_turn(cloud_object("cloud", cube.cloud, origin="cloud"), T), np.eye(3))


@pytest.mark.parametrize("make", [tuple, list, np.array, torch.tensor])
def test_a_place_is_any_kind_of_vector_or_a_surface_or_a_place(make: Any) -> None:
    np.testing.assert_allclose(Place.of(make([0.5, 0.1, 0.0])).spot, (0.5, 0.1, 0.0), atol=1e-7)
    turned = Place.of(make([0.5, 0.1, 0.0, 1.5]))
    assert (turned.yaw, Place.of(turned), Place.of("box").surface) == (1.5, turned, "box")


def places(robot: dro.Robot, standing: Standing, wanted: object, *obstacles: dro.ObjectModel) -> Places:
    obj, T = standing
    return Placing(Workcell(robot, obstacles, obj, T), Place.of(wanted)).places()  # type: ignore[arg-type]


@pytest.mark.parametrize(("table", "above"), [(0.01, 0.02), (None, 0.0)])
def test_a_cloud_without_its_underside_is_put_as_high_above_a_surface_as_it_was_seen(
    robot: dro.Robot, table: float | None, above: float
) -> None:
    down = np.diag([1.0, -1.0, -1.0, 1.0])  # the cloud's frame looks down
    points = np.random.default_rng(0).uniform((-0.03, -0.03, 0.03), (0.03, 0.03, 0.1), (4000, 3))
    seen = cloud_object("cloud", points @ down[:3, :3], origin="cloud", keep_table=True)
    obj = replace(seen, table=None if table is None else np.array([0.0, 0.0, -1.0, table]))
    down[:3, 3] = 0.5, 0.1, 0.0
    found = places(robot, (obj, down), (0.4, -0.2, 0.0))
    for motion in found.motions:
        T = motion @ down
        assert (obj.cloud @ T[2, :3]).min() + T[2, 3] == pytest.approx(above, abs=1e-3)


@pytest.mark.parametrize(("spot", "message"), [
    ((0.5, 0.75, 0.0), "5.0 cm outside the table, which reaches from (-0.15, -0.70) to (1.05, 0.70) m"),
    ((0.5, -0.1, -0.03), "is 3.0 cm below the table at 0.000 m"),
    ((0.5, -0.1, 0.12), "is in the air: nothing carries the object there, and the table is 12.0 cm lower"),
    ((3.0, 0.0, 0.0), "is 3.00 m from the base, farther than the arm and hand are long"),
    ((0.33, 0.1, 0.0), "deep in 'wall'"),
])
def test_an_impossible_place_is_refused_with_the_distance(
    robot: dro.Robot, standing: Standing, wall: dro.ObjectModel, spot: tuple[float, float, float], message: str
) -> None:
    with pytest.raises(PlanError) as caught:
        places(robot, standing, spot, wall)
    assert message in str(caught.value)


@pytest.mark.usefixtures("as_users_have_it")
@pytest.mark.parametrize("given", [(0.5, 0.1), (0.5, 0.1, math.nan), (1, 2, 3, 4, 5), (1, 2, "x"), 7])
def test_what_is_no_place_is_refused(robot: dro.Robot, standing: Standing, given: object) -> None:
    with pytest.raises(OptionError, match="give X Y Z of the object's foot in metres"):
        plan(robot, *standing, place=given)  # type: ignore[arg-type]


def test_a_free_place_of_the_table_is_chosen(robot: dro.Robot, standing: Standing, wall: dro.ObjectModel) -> None:
    obj, T = standing
    corners, table = np.asarray(obj.vertices) @ T[:3, :3].T + T[:3, 3], robot.table
    assert table is not None
    found = places(robot, standing, "table", wall).motions
    assert len(found) == SPOTS * TURNS // 2
    for motion in found:
        moved = corners @ motion[:3, :3].T + motion[:3, 3]
        assert np.linalg.norm(foot(moved)[:2] - foot(corners)[:2]) > AWAY - 1e-6
        assert max(off_table(table, corner) for corner in moved) < 0
        assert float(wall.distance_field.distances(torch.from_numpy(moved).float()[None])[0].min()) > 0.02
    with pytest.raises(PlanError, match="nothing is called 'shelf' to put the object on; there are 'table', 'wall'"):
        places(robot, standing, "shelf", wall)
    tile = np.stack(np.meshgrid(np.arange(0, 0.3, 0.02), np.arange(0, 0.3, 0.02), [0.05]), -1).reshape(-1, 3)
    tiles = [cloud_object("tile", tile + np.array([x, y, 0]), origin="tile", keep_table=True)
             for x in np.arange(-0.2, 1.1, 0.3) for y in np.arange(-0.7, 0.7, 0.3)]
    with pytest.raises(PlanError, match="'can' fits nowhere on 'table', 15 cm from where it stands"):
        places(robot, standing, "table", *tiles)


@pytest.mark.parametrize("as_cloud", [False, True])
def test_a_thing_carries_an_object(robot: dro.Robot, standing: Standing, tmp_path: Path, as_cloud: bool) -> None:
    """Of a cloud each cell counts, which reaches above the points; the object stands on the points all the same."""
    block = box(tmp_path / "block.obj", (0.2, 0.2, 0.083), (0.4, -0.25, 0.0415))
    thing = cloud_object("block", block.cloud, origin="block", keep_table=True) if as_cloud else block
    for wanted in ("block", (0.4, -0.25, 0.083)):
        moved = places(robot, standing, wanted, thing).motions[0]
        end = moved[:3, :3] @ foot(np.asarray(standing[0].vertices) + standing[1][:3, 3]) + moved[:3, 3]
        np.testing.assert_allclose(end, (0.4, -0.25, 0.083), atol=0.005)


def test_a_grasp_that_cannot_place_is_dropped(robot: dro.Robot, standing: Standing, placed: MotionPlan) -> None:
    """Upside down, for which the hand would be in the table; and as it stands, where it works."""
    obj, T = standing
    cell, n = Workcell(robot, (), obj, T), placed.notes.chosen
    grasps = plan_grasps(robot, placed)
    here, over = np.eye(4), np.eye(4)
    over[:3, :3] = np.diag([1.0, -1.0, -1.0])
    over[:3, 3] = 0, 0.2, float(np.ptp(obj.cloud[:, 2]))
    for motions, works in (([here], True), ([over], False), ([over, here], True)):
        found = Reachability(cell, ReachConfig(), 0, Places(motions, 0.002)).ways(grasps, n)
        if works:
            assert not isinstance(found, str)
            assert found.put is not None
            np.testing.assert_allclose(found.put.moved, here, atol=3e-3)
        else:
            assert found == Fault.NO_PLACE


def test_what_shifts_in_the_hand_is_put_where_it_shall_stand_all_the_same(
    robot: dro.Robot, standing: Standing, placed: MotionPlan
) -> None:
    """By 8 mm and 3 degrees; and nothing changes for half a millimetre."""
    obj, T = standing
    aside, grasps = np.eye(4), plan_grasps(robot, placed)
    aside[:2, 3] = 0.02, -0.05
    reach = Reachability(Workcell(robot, (), obj, T), ReachConfig(), 0, Places([aside], 0.004))
    found = reach.ways(grasps, placed.notes.chosen)
    assert not isinstance(found, str)
    assert found.put is not None
    shift = np.eye(4)
    shift[:3, :3] = Rotation.from_rotvec([0.05, 0.0, 0.02]).as_matrix()
    shift[:3, 3] = 0.0, 0.008, 0.0
    held = found.put.T_grasp @ shift
    again = reach.put_as_held(found, grasps, held)
    assert again.put is not None

    def ends(put: Put) -> np.ndarray:
        """Where the motion brings the object's corners, in the hand as it is."""
        motion = robot.T_world_wrist(put.lower[-1]) @ np.linalg.inv(held)
        return (obj.vertices @ T[:3, :3].T + T[:3, 3]) @ motion[:3, :3].T + motion[:3, 3]

    wanted = obj.vertices @ T[:3, :3].T + T[:3, 3] + aside[:3, 3]
    assert np.linalg.norm(ends(again.put) - wanted, axis=1).max() < 2e-3
    assert np.linalg.norm(ends(found.put) - wanted, axis=1).max() > 7e-3
    shift[:3, :3], shift[:3, 3] = np.eye(3), (0.0, 5e-4, 0.0)
    assert reach.put_as_held(found, grasps, found.put.T_grasp @ shift) is found


def plan_grasps(robot: dro.Robot, made: MotionPlan) -> dro.GraspBatch:
    """The grasps of a plan, which close and squeeze as the chosen one does."""
    joints = torch.from_numpy(made.scene.joints).float()
    close = made.hand.position[made.part("close")]
    first, last = (torch.from_numpy(row).float().expand_as(joints) for row in close[[0, -1]])
    wrists = torch.from_numpy(made.scene.T_world_wrist).float()
    return dro.GraspBatch.create(robot.hand, dro.load_object("can"), wrists, joints, pregrasp_joints=first, squeeze_joints=last)


def test_errors_of_a_place_are_measured_about_the_centre_of_mass(robot: dro.Robot, placed: MotionPlan) -> None:
    can = dro.load_object("can")
    scene, start, off = LiftScene(Workcell(robot), [can]), np.eye(4), np.eye(4)
    result = Attempt(robot.name, "can", 0, 0, "")
    wanted = np.array(placed.notes.place)
    for shift, tilt, expected in ((0.013, 0.1, "done"), (0.031, 0.0, "place"), (0.0, 0.4, "place"), (0.0, 1.5, "place")):
        off[1:3, 1:3] = [[math.cos(tilt), -math.sin(tilt)], [math.sin(tilt), math.cos(tilt)]]
        T = np.eye(4)
        T[:3, :3] = off[:3, :3] @ wanted[:3, :3]
        T[:3, 3] = wanted[:3, :3] @ can.centre_of_mass + wanted[:3, 3] + (shift, 0, 0) - T[:3, :3] @ can.centre_of_mass
        scene.place(0, T)
        found = measured(result, scene, start, placed)
        assert found.place_error == pytest.approx(shift, abs=1e-6)
        assert found.place_tilt == pytest.approx(math.degrees(tilt), abs=1e-3)
        assert found.place_error is not None
        assert found.place_tilt is not None
        stage, reason = place_fault(found.place_error, found.place_tilt)
        assert (stage, bool(reason)) == (expected, expected != "done")
    assert place_fault(0.031, 1.0) == ("place", "placed 3.1 cm off")
    assert "fell over: it is tilted by 86 degrees" in place_fault(0.0, 86.0)[1]


def test_a_drawn_place_is_free_and_away(robot: dro.Robot) -> None:
    can, tin = dro.load_object("can"), dro.load_object("tin")
    scene, region = LiftScene(Workcell(robot), [can, tin]), TabletopConfig().region
    here, there = np.eye(4), np.eye(4)
    here[:3, 3], there[:3, 3] = (0.5, 0.1, 0.06), (0.48, -0.1, 0.025)
    scene.place(0, here)
    scene.place(1, there)
    for seed in range(20):
        x, y, z = draw_place(scene, PickedObject(can, [], robot), region, np.random.default_rng(seed))
        assert region[0] <= x <= region[2]
        assert region[1] <= y <= region[3]
        assert z == 0
        assert math.hypot(x - 0.5, y - 0.1) > AWAY
        assert math.hypot(x - 0.48, y + 0.1) > 0.033 + 0.045


def test_an_attempt_places_what_it_lifts(robot: dro.Robot) -> None:
    """The whole experiment, on the true mesh."""
    result = attempt(robot, dro.load_object("can"), 0, 0, dro.GraspPredictor(), QUICK)
    assert (result.stage, result.reason) == ("done", "")
    assert result.success
    assert (result.place_error or 1.0) < 0.02
    assert (result.place_tilt or 0.0) < 15


def test_settings_without_a_place_are_called_as_before() -> None:
    assert "place" not in TabletopConfig().label()
    config = TabletopConfig(place=True)
    assert TabletopConfig.from_label(config.label()) == config
    assert TabletopConfig.from_label(TabletopConfig().label()) == TabletopConfig()
