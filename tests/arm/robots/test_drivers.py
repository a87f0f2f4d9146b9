"""What drivers count otherwise than a robot's description does."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import dro_grasp as dro
from dro_grasp.arm.planning.motion import MotionPlan
from dro_grasp.arm.robot_check import check_robot
from dro_grasp.arm.robots.drivers import Drivers
from dro_grasp.arm.robots.loading import load_robot
from dro_grasp.errors import RobotError
from tests.helpers.robot_files import written, xarm7
from tests.helpers.strange_hands import block, robot as whole, sliding


@pytest.fixture
def values() -> dict[str, Any]:
    return xarm7()


def test_zeros_signs_and_units_make_the_drivers_numbers(values: dict[str, Any], tmp_path: Path) -> None:
    robot = load_robot(written(values, tmp_path))
    hand = robot.hand_joints[0]
    stated = {"zeros": {"joint2": -1.0, hand: 0.25}, "signs": {"joint2": -1}, "units": {"joint2": "deg", hand: 650.0}}
    other = load_robot(written(values | stated, tmp_path))
    q = np.random.default_rng(0).uniform(-1, 1, (5, len(robot.arm_joints) + len(robot.hand_joints)))
    told = other.drivers.positions(q)
    for i, name in enumerate((*robot.arm_joints, *robot.hand_joints)):
        expected = {"joint2": -np.degrees(q[:, i] + 1.0), hand: 650.0 * (q[:, i] - 0.25)}.get(name, q[:, i])
        np.testing.assert_allclose(told[:, i], expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(other.drivers.joints(told), q, atol=1e-12)
    step = 1e-3 * np.ones(q.shape[1])  # rates are what positions change by
    np.testing.assert_allclose(other.drivers.rates(step), other.drivers.positions(q[0] + step) - told[0], atol=1e-9)
    assert other.drivers.efforts(np.ones(q.shape[1])).tolist() == [-1.0 if n == "joint2" else 1.0 for n in (
        *robot.arm_joints, *robot.hand_joints)]
    assert robot.drivers.are_usual
    assert not other.drivers.are_usual
    assert other.sha256 == robot.sha256, "motions are the same"


def test_the_report_names_what_is_counted_otherwise(values: dict[str, Any], tmp_path: Path) -> None:
    report = check_robot(written(values | {"zeros": {"joint1": 0.5}, "units": {"joint1": "turn"}}, tmp_path))
    line, = (line for line in report.lines() if "driver" in line)
    assert line == "  driver of joint1: zero at 0.5, 0.159155 in a radian or metre"
    assert json.loads(json.dumps(report.to_dict()))["drivers"]["joint1"] == {"zero": 0.5, "scale": 0.5 / math.pi}


@pytest.mark.parametrize(("stated", "told"), [
    ({"zeros": {"joint9": 1}}, "zeros names joint 'joint9'; the joints of arm and hand are joint1, joint2"),
    ({"zeros": {"joint1": "x"}}, "zeros of joint joint1 is 'x'; expected a number"),
    ({"zeros": {"joint1": -500}}, r"zeros of joint joint1 is -500, as if it were in degrees; expected -6\.283 to 6\.283 rad"),
    ({"signs": {"joint1": 2}}, "signs of joint joint1 is 2; expected 1, or -1 where its driver counts the other way"),
    ({"signs": [1, -1]}, r"signs is \[1, -1\]; expected entries 'name: value'"),
    ({"units": {"joint1": "mm"}}, "units of joint joint1 is 'mm'; expected rad, deg, turn, or how many of them a radian has"),
    ({"units": {"joint1": -4096}}, "units of joint joint1 is -4096; expected a number above 0"),
])
def test_what_cannot_be_is_refused(values: dict[str, Any], tmp_path: Path, stated: dict[str, Any], told: str) -> None:
    with pytest.raises(RobotError, match=told):
        load_robot(written(values | stated, tmp_path))


def test_sliding_joints_have_lengths(values: dict[str, Any], tmp_path: Path) -> None:
    jaws = (sliding(name, f"0 {-side} 0", 0.0, 0.035, at=f"0 {side * 0.04} 0.06")
            for name, side in (("left", 1), ("right", -1)))
    (tmp_path / "jaws.urdf").write_text(whole(block("palm", "0.06 0.12 0.06"), *jaws))
    values |= {"hand": str(tmp_path / "jaws.urdf")}
    told = load_robot(written(values | {"units": {"left_slide": "mm"}}, tmp_path)).drivers
    assert told.positions(np.full(len(told.zeros), 0.02))[-2:] == pytest.approx([20.0, 0.02])
    with pytest.raises(RobotError, match="zeros of joint left_slide is 20, as if it were in millimetres; expected -10 to 10 m"):
        load_robot(written(values | {"zeros": {"left_slide": 20}}, tmp_path))
    with pytest.raises(RobotError, match="units of joint left_slide is 'deg'; expected m, cm, mm, or how many of them a metre"):
        load_robot(written(values | {"units": {"left_slide": "deg"}}, tmp_path))


def test_a_hand_is_as_fast_as_its_description_says_and_slides_are_slow(values: dict[str, Any], tmp_path: Path) -> None:
    jaws = (sliding(name, f"0 {-side} 0", 0.0, 0.035, at=f"0 {side * 0.04} 0.06")
            for name, side in (("left", 1), ("right", -1)))
    text = whole(block("palm", "0.06 0.12 0.06"), *jaws)
    (tmp_path / "jaws.urdf").write_text(text)
    values |= {"hand": str(tmp_path / "jaws.urdf")}
    values.pop("hand_limits", None)
    robot = load_robot(written(values, tmp_path))
    assert (robot.hand_velocity <= 0.06 + 1e-9).all()
    assert robot.hand_acceleration.tolist() == pytest.approx([0.3, 0.3])
    slow = re.sub(r'velocity="[^"]*"', 'velocity="0.02"', text)
    assert slow != text
    (tmp_path / "jaws.urdf").write_text(slow)
    assert load_robot(written(values, tmp_path)).hand_velocity.tolist() == pytest.approx([0.02, 0.02])
    stated = {"hand_limits": {"velocity": {"left_slide": 0.1}, "acceleration": 0.5}}
    robot = load_robot(written(values | stated, tmp_path))
    assert dict(zip(robot.hand_joints, robot.hand_velocity, strict=True)) == {"left_slide": 0.1, "right_slide": 0.02}
    assert robot.hand_acceleration.tolist() == [0.5, 0.5]
    with pytest.raises(RobotError, match="hand_limits: velocity names joint 'thumb'"):
        load_robot(written(values | {"hand_limits": {"velocity": {"thumb": 1.0}}}, tmp_path))


def test_usual_drivers_count_as_the_description_does() -> None:
    usual, q = Drivers.usual(3), np.array([0.1, -2.0, 0.0])
    assert usual.positions(q).tolist() == usual.rates(q).tolist() == q.tolist()
    assert usual.lines(("a", "b", "c")) == []


def test_what_is_sent_is_in_the_drivers_numbers(planned: MotionPlan, tmp_path: Path) -> None:
    names = (*planned.notes.arm_joints, *planned.notes.hand_joints)
    count = len(planned.notes.arm_joints)
    rng = np.random.default_rng(0)
    zeros, scales = rng.uniform(-1, 1, len(names)), rng.uniform(0.5, 60, len(names)) * rng.choice([-1, 1], len(names))
    torque = tuple(rng.uniform(-0.3, 0.3, len(names) - count).tolist())
    notes = replace(planned.notes, zeros=tuple(zeros.tolist()), scales=tuple(scales.tolist()), squeeze_torque=torque)
    replace(planned, notes=notes).save(tmp_path / "plan.npz")
    other = MotionPlan.load(tmp_path / "plan.npz")
    np.testing.assert_array_equal(other.arm.position, planned.arm.position)  # simulated and looked at as described

    rows = list(csv.DictReader(io.StringIO(dro.trajectory_csv(other))))
    both = np.concatenate([planned.arm.position, planned.hand.position], 1)
    for i, name in enumerate(names):
        column = f"{'arm' if i < count else 'hand'}/{name}"
        found = np.array([float(row[column]) for row in rows])
        np.testing.assert_allclose(found, scales[i] * (both[:, i] - zeros[i]), atol=1e-4)
    last = list(other.points(50))[-1]
    np.testing.assert_allclose(last.hand, scales[count:] * (planned.hand.position[-1] - zeros[count:]), atol=1e-9)
    np.testing.assert_allclose(last.hand_effort, np.sign(scales[count:]) * torque, atol=1e-9)

    text = dro.trajectory_yaml(other, efforts=True)
    messages = yaml.safe_load(text)
    assert "Joints in the drivers' numbers" in text.splitlines()[0]
    middle = messages["arm"]["points"][len(rows) // 2]
    np.testing.assert_allclose(middle["velocities"], scales[:count] * planned.arm.velocity[len(rows) // 2], atol=1e-4)
    np.testing.assert_allclose(messages["squeeze"]["effort"], np.sign(scales[count:]) * torque, atol=1e-5)
    np.testing.assert_allclose(messages["squeeze"]["position"], last.hand, atol=1e-4)
