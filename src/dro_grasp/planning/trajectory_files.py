"""A plan as files for controllers: trajectory_msgs/JointTrajectory as YAML, and CSV."""

from __future__ import annotations

import csv
import io

import numpy as np
from jaxtyping import Float

from dro_grasp.export.contents import yaml_text
from dro_grasp.planning.motion import STAGES, MotionPlan
from dro_grasp.planning.timing import Trajectory

DIGITS = 6
"""Decimals of joint values: micrometres and microradians (ours)."""


def trajectory_yaml(plan: MotionPlan) -> str:
    """One trajectory_msgs/JointTrajectory each for arm and hand, with the same times. Source: ROS 2 common_interfaces."""
    notes, times = plan.notes, {name: round(float(plan.arm.time[plan.part(name)][-1]), DIGITS) for name in STAGES}
    lines = [
        f"# Robot '{notes.robot}' lifts object '{notes.object}'. Joints in rad or m, time in s.",
        f"# The wrist pose of the grasp is in frame '{notes.frame}'. Stages end at (s): {times}",
    ]
    messages = {"arm": _message(notes.frame, notes.arm_joints, plan.arm), "hand": _message(
        notes.frame, notes.hand_joints, plan.hand)}
    return "\n".join([*lines, yaml_text(messages)])


def trajectory_csv(plan: MotionPlan) -> str:
    """One row for each sample: time, stage, and the target of every joint, arm before hand."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    joints = [f"arm/{n}" for n in plan.notes.arm_joints] + [f"hand/{n}" for n in plan.notes.hand_joints]
    table.writerow(["time", "stage", *joints])
    for i, time in enumerate(plan.arm.time.tolist()):
        values = _plain(np.concatenate([plan.arm.position[i], plan.hand.position[i]]))
        table.writerow([round(time, DIGITS), STAGES[int(plan.stage[i])], *values])
    return text.getvalue()


def _message(frame: str, names: tuple[str, ...], part: Trajectory) -> dict[str, object]:
    points = []
    for i, time in enumerate(part.time.tolist()):
        second, nanosecond = divmod(round(time * 1e9), 10**9)
        points.append({
            "positions": _plain(part.position[i]), "velocities": _plain(part.velocity[i]),
            "accelerations": _plain(part.acceleration[i]), "effort": [],
            "time_from_start": {"sec": second, "nanosec": nanosecond}})
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": frame}
    return {"header": header, "joint_names": list(names), "points": points}


def _plain(values: Float[np.ndarray, " n"]) -> list[float]:
    return np.round(values, DIGITS).tolist()
