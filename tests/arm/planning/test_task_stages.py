"""The stages of a task lead from where the plan begins to where it ends, by MuJoCo's kinematics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

import dro_grasp as dro
from dro_grasp.arm.planning.motion import MotionPlan
from dro_grasp.arm.planning.task_stages import task_stages, task_yaml
from dro_grasp.arm.planning.workcell import Workcell


def wrist(robot: dro.Robot, arm: dict[str, float]) -> np.ndarray:
    cell = Workcell(robot)
    cell.contacts(robot.home, robot.open_hand)  # the first call looks at home
    cell.contacts(np.array([arm[name] for name in robot.arm_joints]), robot.open_hand)
    body, T = cell.data.body(f"hand/{robot.hand.wrist_link}"), np.eye(4)
    T[:3, :3], T[:3, 3] = body.xmat.reshape(3, 3), body.xpos
    return T


def test_stages_lead_to_the_grasp_and_up(planned: MotionPlan, robot: dro.Robot) -> None:
    stages = yaml.safe_load(task_yaml(planned, robot))["stages"]
    assert [stage["name"] for stage in stages] == [
        "current state", "open", "reach", "shape", "hand may touch", "approach", "close", "attach", "lift"]
    assert [stage["type"] for stage in stages] == [
        "CurrentState", "MoveTo", "MoveTo", "MoveTo", "ModifyPlanningScene", "MoveRelative", "MoveTo", "ModifyPlanningScene",
        "MoveRelative"]
    by_name = {stage["name"]: stage for stage in stages}
    goal = by_name["reach"]["goal"]
    T = wrist(robot, goal["joints"])
    np.testing.assert_allclose(goal["pose"]["position"], T[:3, 3], atol=2e-6)
    turn = Rotation.from_quat(goal["pose"]["orientation_wxyz"], scalar_first=True)
    np.testing.assert_allclose(turn.as_matrix(), T[:3, :3], atol=1e-5)
    at = T[:3, 3] + by_name["approach"]["distance"] * np.array(by_name["approach"]["direction"])
    np.testing.assert_allclose(at, np.array(planned.notes.T_world_wrist)[:3, 3], atol=2e-3)  # inverse kinematics ends there
    assert by_name["lift"]["direction"] == pytest.approx([0, 0, 1], abs=1e-3)
    assert by_name["lift"]["distance"] == pytest.approx(0.2, abs=2e-3)
    close = by_name["close"]
    assert list(close["goal"]["joints"].values()) == pytest.approx(planned.hand.position[-1].tolist(), abs=1e-6)
    assert (planned.notes.squeeze_torque is None) == ("effort" not in close)
    assert planned.hold is not None
    for state, what, values in (("held", "joints", planned.hold.held_joints), ("empty", "effort", planned.hold.empty_efforts)):
        assert close["expected"][state][what] == pytest.approx(
            dict(zip(robot.hand_joints, values.tolist(), strict=True)), abs=1e-6)
    assert close["expected"]["weight"] == pytest.approx(planned.hold.weight, abs=1e-6)
    silent = replace(planned, notes=replace(planned.notes, hold=None))
    assert not any("expected" in stage for stage in task_stages(silent, robot))
    assert by_name["attach"]["attach_objects"] == {"objects": [planned.notes.object], "link": robot.hand.wrist_link}


def test_only_what_moves_is_a_straight_motion(planned: MotionPlan, robot: dro.Robot) -> None:
    still = planned.arm.position.copy()
    still[planned.part("lift")] = still[planned.part("lift")][0]
    arm = type(planned.arm)(planned.arm.time, still, planned.arm.velocity, planned.arm.acceleration)
    names = [stage["name"] for stage in task_stages(replace(planned, arm=arm), robot)]
    assert "lift" not in names
    assert "approach" in names
