"""Plan files, and what drivers and controllers get."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import dro_grasp as dro
from dro_grasp.arm.planning.motion import STAGES, MotionPlan, Trajectory
from dro_grasp.arm.planning.task_stages import task_yaml
from dro_grasp.arm.planning.workcell import Workcell
from dro_grasp.errors import PlanError


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


@pytest.mark.parametrize("rate", [100, 250, 1000])
def test_fast_loops_get_no_jumps_of_velocity(planned: MotionPlan, rate: float, robot: dro.Robot) -> None:
    points = list(planned.points(rate))
    time, arm = np.array([p.time for p in points[:-1]]), np.stack([p.arm for p in points[:-1]])
    change = np.abs(np.diff(arm, n=2, axis=0)) * rate**2 / robot.acceleration
    assert len(time) == np.ceil(planned.seconds * rate - 1e-9)
    assert change.max() < 1.3, "of the limits; straight lines between samples gave nine times as much"


@pytest.mark.parametrize("rate", [0, -5, np.nan, np.inf])
def test_a_rate_that_gives_no_points_is_refused(planned: MotionPlan, rate: float) -> None:
    with pytest.raises(dro.DroGraspError, match="give how many points a second has"):
        planned.points(rate)


def test_names_break_no_file(planned: MotionPlan, robot: dro.Robot) -> None:
    strange = replace(planned, notes=replace(planned.notes, object="my\nmug: [", robot="a\n- b"))
    assert yaml.load(dro.trajectory_yaml(strange), yaml.CSafeLoader)["arm"]["points"]
    assert yaml.load(task_yaml(strange, robot), yaml.CSafeLoader)["stages"]


def test_a_way_beyond_the_limits_of_joints_is_not_free(robot: dro.Robot) -> None:
    cell, q = Workcell(robot), robot.home.copy()
    assert cell.free(q, robot.open_hand)
    q[0] = robot.upper[0] + 1e-3
    assert not cell.free(q, robot.open_hand)


@pytest.fixture
def pressing(planned: MotionPlan) -> MotionPlan:
    """The plan with forces of its grasp."""
    torque = tuple(0.1 * (-1) ** i * (i + 1) for i in range(len(planned.notes.hand_joints)))
    return replace(planned, notes=replace(planned.notes, payload=0.8, squeeze_force=6.25, squeeze_torque=torque))


def refusal(message: dict[str, Any], interfaces: set[str]) -> str | None:
    """Why a joint_trajectory_controller of ROS 2 refuses a message; None if it takes it.

    Source: `validate_trajectory_msg` of ros2_controllers.
    """
    n, before = len(message["joint_names"]), -1.0
    for point in message["points"]:
        time = point["time_from_start"]["sec"] + 1e-9 * point["time_from_start"]["nanosec"]
        if time <= before:
            return "time is not strictly increasing"
        before = time
        for name, may_lack in (("positions", False), ("velocities", True), ("accelerations", True), ("effort", True)):
            if len(point[name]) != n and not (may_lack and not point[name]):
                return f"mismatch of joint_names and {name}"
        if point["effort"] and "effort" not in interfaces:
            return "efforts without an effort interface"
    return None


def test_efforts_grow_from_the_grasp_to_the_squeeze_and_stay(pressing: MotionPlan) -> None:
    effort, full = pressing.hand_effort, np.array(pressing.notes.squeeze_torque)
    assert effort is not None
    close, lift = (pressing.stage == STAGES.index(name) for name in ("close", "lift"))
    assert (effort[pressing.stage < STAGES.index("close")] == 0).all()
    np.testing.assert_allclose(effort[lift], np.tile(full, (lift.sum(), 1)))
    share = effort[close] @ full / (full @ full)
    assert (np.diff(share) >= -1e-9).all()
    assert share[0] == 0
    assert share[-1] == pytest.approx(1)
    # The middle of the way from grasp to squeeze has half of the effort.
    grasp, squeeze = pressing.scene.joints[pressing.notes.chosen], pressing.hand.position[-1]
    halfway = replace(pressing, hand=replace(pressing.hand, position=np.concatenate([
        np.tile((grasp + squeeze) / 2, (len(pressing.stage) - 1, 1)), squeeze[None]])))
    np.testing.assert_allclose(halfway.hand_effort[close], np.tile(full / 2, (close.sum(), 1)), atol=1e-9)
    points = list(pressing.points(rate=50))
    assert (points[0].hand_effort == 0).all()
    np.testing.assert_allclose(points[-1].hand_effort, full)


def test_a_controller_of_positions_takes_the_trajectory_and_one_of_efforts_gets_them(pressing: MotionPlan) -> None:
    usual, with_efforts = (yaml.load(dro.trajectory_yaml(pressing, efforts=e), yaml.CSafeLoader) for e in (False, True))
    for name in ("arm", "hand"):
        assert refusal(usual[name], {"position"}) is None
    assert refusal(with_efforts["arm"], {"position"}) is None
    assert refusal(with_efforts["hand"], {"position"}) == "efforts without an effort interface"
    assert refusal(with_efforts["hand"], {"effort"}) is None
    np.testing.assert_allclose([p["effort"] for p in with_efforts["hand"]["points"]], pressing.hand_effort, atol=1e-6)
    assert usual["squeeze"]["name"] == usual["hand"]["joint_names"]
    np.testing.assert_allclose(usual["squeeze"]["position"], pressing.hand.position[-1], atol=1e-6)
    np.testing.assert_allclose(usual["squeeze"]["effort"], pressing.notes.squeeze_torque, atol=1e-6)
    assert "# The grasp carries 0.8 kg, squeezes with 6.2 N.\n" in dro.trajectory_yaml(pressing)
    assert pressing.lines()[1].endswith("; it carries 0.8 kg, squeezes with 6.2 N")
    rows = list(csv.DictReader(io.StringIO(dro.trajectory_csv(pressing))))
    columns = [[float(row[f"effort/{joint}"]) for joint in pressing.notes.hand_joints] for row in rows]
    np.testing.assert_allclose(columns, pressing.hand_effort, atol=1e-6)


def test_plans_keep_their_forces_and_those_without_say_nothing(
    planned: MotionPlan, pressing: MotionPlan, tmp_path: Path
) -> None:
    pressing.save(tmp_path / "plan.npz")
    again = MotionPlan.load(tmp_path / "plan.npz")
    assert again.notes == pressing.notes
    np.testing.assert_allclose(again.hand_effort, pressing.hand_effort, atol=1e-6)
    silent = replace(planned, notes=replace(planned.notes, payload=None, squeeze_force=None, squeeze_torque=None, hold=None))
    assert silent.hand_effort is None
    assert next(silent.points()).hand_effort is None
    messages = yaml.load(dro.trajectory_yaml(silent, efforts=True), yaml.CSafeLoader)
    assert messages.keys() == {"arm", "hand"}
    assert all(point["effort"] == [] for point in messages["hand"]["points"])
    assert "effort/" not in dro.trajectory_csv(silent)
    assert silent.lines()[1].endswith("in frame 'world'")
    silent.save(tmp_path / "silent.npz")
    with np.load(tmp_path / "silent.npz") as file:
        arrays = dict(file)
    header = json.loads(str(arrays["header"]))
    for name in ("payload", "squeeze_force", "squeeze_torque", "hold"):  # a plan file from before there were any
        assert header.pop(name) is None
    np.savez(tmp_path / "old.npz", **arrays | {"header": np.array(json.dumps(header))})
    assert MotionPlan.load(tmp_path / "old.npz").notes == silent.notes


def test_a_plan_says_what_to_expect_of_the_hold_and_checks_it(planned: MotionPlan, tmp_path: Path) -> None:
    expected = planned.hold
    assert expected is not None
    moving = np.abs(expected.empty_joints - expected.held_joints).max()
    assert moving > 0.02, "fingers go on where there is no can"
    assert np.linalg.norm(expected.held_efforts) > np.linalg.norm(expected.empty_efforts), "fingers meet each other, too"
    np.testing.assert_allclose(expected.empty_joints, planned.hand.position[-1], atol=0.15)
    assert planned.check_hold(expected.held_joints, expected.held_efforts).state == "held"
    assert planned.check_hold(expected.empty_joints, expected.empty_efforts).state == "empty"
    assert expected.weight is not None
    assert planned.check_hold(expected.held_joints, expected.held_efforts, load=expected.weight).state == "held"
    planned.save(tmp_path / "plan.npz")
    again = MotionPlan.load(tmp_path / "plan.npz")
    assert again.notes == planned.notes
    assert f"# The object should weigh {expected.weight:.3g} N." in dro.trajectory_yaml(planned)
    messages = yaml.load(dro.trajectory_yaml(planned), yaml.CSafeLoader)
    for name, joints, efforts in (("held", expected.held_joints, expected.held_efforts),
                                  ("empty", expected.empty_joints, expected.empty_efforts)):
        assert messages[name]["name"] == list(planned.notes.hand_joints)
        np.testing.assert_allclose(messages[name]["position"], joints, atol=1e-6)
        np.testing.assert_allclose(messages[name]["effort"], efforts, atol=1e-6)
    count = len(planned.notes.arm_joints) + len(expected.held_joints)
    scales = tuple(np.resize([57.3, -1.0, 1000.0], count).tolist())
    driven = replace(planned, notes=replace(planned.notes, zeros=(0.2,) * count, scales=scales))
    read = yaml.load(dro.trajectory_yaml(driven), yaml.CSafeLoader)
    for state in ("held", "empty"):
        rows = np.tile(read[state]["position"], (11, 1))
        assert driven.check_hold(rows[-1], read[state]["effort"], watched=rows, from_drivers=True).state == state
        assert driven.check_hold(rows[-1]).state == "unexpected", "numbers of drivers are no radians"
    np.testing.assert_allclose(driven.check_hold(read["held"]["position"], from_drivers=True).probabilities["held"],
                               planned.check_hold(expected.held_joints).probabilities["held"], atol=1e-6)
    before = replace(planned, notes=replace(planned.notes, hold=None))
    assert before.hold is None
    with pytest.raises(dro.DroGraspError, match="plan again"):
        before.check_hold(expected.held_joints)


def test_a_plan_file_in_which_a_stage_has_no_rows_is_read(planned: MotionPlan) -> None:
    """As they were written before."""
    rows = planned.stage != STAGES.index("shape")
    arm, hand = (Trajectory(t.time[rows], t.position[rows], t.velocity[rows], t.acceleration[rows])
                 for t in (planned.arm, planned.hand))
    old = replace(planned, stage=planned.stage[rows], arm=arm, hand=hand)
    assert "shape 0.0 s" in old.lines()[2]
    assert old.part("shape") == slice(old.part("reach").stop - 1, old.part("reach").stop)
