"""A plan as the stages of a task, for MoveIt Task Constructor and others that plan the motions between them anew.

Each stage has the name of a class of MoveIt Task Constructor as `type`, and the values that its setters take. Joints are those
of the robot's description. The stage that closes the hand also states what to expect of its joints after the lift, with the
object and without, as `expected`. Source: MoveIt Task Constructor, stages MoveTo, MoveRelative and ModifyPlanningScene.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from dro_grasp.arm.planning.motion import DIGITS, MotionPlan
from dro_grasp.arm.planning.workcell import wxyz
from dro_grasp.arm.robots.robot import Robot
from dro_grasp.grasps.export.writers import on_one_line, yaml_text

ARM = "arm"  # Name of the group of the arm's joints
HAND = "hand"  # And of those of the hand
SHORTEST = 0.001  # Straight motions that are shorter are none [m] (ours)


def task_stages(plan: MotionPlan, robot: Robot) -> list[dict[str, Any]]:
    """The stages of a plan for a robot, in their order, as plain values: metres, radians, quaternions WXYZ, Nm or N."""
    hand, wrist, thing = robot.hand_joints, robot.hand.wrist_link, plan.notes.object
    touching = {"first": thing, "second": list(robot.hand.tree.link_names)}
    held = {"objects": [thing], "link": wrist}

    def shaped(name: str, stage: str) -> dict[str, Any]:
        return _joints(name, hand, _last(plan, HAND, stage))

    def ways(*names: str) -> list[dict[str, Any]]:
        return [part for name in names for part in _straight(name, plan, robot)]

    stages = [shaped("open", "reach"), _pose("reach", plan, robot), shaped("shape", "shape"),
              {"name": "hand may touch", "type": "ModifyPlanningScene", "allow_collisions": touching}]
    if plan.notes.slide is not None:
        stages += [*ways("approach", "press", "slide", "retreat"), shaped("open again", "look again"),
                   _pose("look again", plan, robot)]
    else:
        stages += [
            *ways("approach"), _joints("close", hand, plan.squeeze, plan.notes.squeeze_torque) | _expected(plan, hand),
            {"name": "attach", "type": "ModifyPlanningScene", "attach_objects": held}, *ways("lift")]
    if plan.notes.place is not None:
        stages += [
            _pose("carry", plan, robot), *ways("lower"), shaped("release", "release"),
            {"name": "detach", "type": "ModifyPlanningScene", "detach_objects": held}, *ways("retreat"),
            shaped("open again", "retreat")]
    return [{"name": "current state", "type": "CurrentState"}, *(stage | {"frame": plan.notes.frame} for stage in stages)]


def task_yaml(plan: MotionPlan, robot: Robot) -> str:
    """The stages of a plan as YAML."""
    does = "push" if plan.notes.slide is not None else "lift" if plan.notes.place is None else "lift and place"
    title = on_one_line(f"Stages of a task: {does} '{plan.notes.object}' with robot '{robot.name}'.")
    return (f"# {title} Types are those of MoveIt Task Constructor.\n"
            "# Metres, radians, Nm or N; quaternions WXYZ; joints as the robot's description counts them.\n"
            "# Allow object and hand to touch what the object stands on: its name in your scene is not known here.\n"
            + yaml_text({"groups": {ARM: list(robot.arm_joints), HAND: list(robot.hand_joints)},
                         "stages": task_stages(plan, robot)}))


def _last(plan: MotionPlan, group: str, stage: str) -> Float[np.ndarray, " n"]:
    """Joints at the end of a stage."""
    return (plan.arm if group == ARM else plan.hand).position[plan.part(stage)][-1]


def _joints(
    name: str, names: tuple[str, ...], values: Float[np.ndarray, " n"], effort: tuple[float, ...] | None = None
) -> dict[str, Any]:
    """A motion of the hand to joints."""
    stage: dict[str, Any] = {"name": name, "type": "MoveTo", "group": HAND, "goal": {"joints": _named(names, values)}}
    return stage if effort is None else stage | {"effort": _named(names, np.array(effort))}


def _expected(plan: MotionPlan, names: tuple[str, ...]) -> dict[str, Any]:
    """What to expect of a hold; nothing in plans that do not know."""
    if (known := plan.hold) is None:
        return {}
    told: dict[str, Any] = {state: {"joints": _named(names, joints), "effort": _named(names, efforts)}
                            for state, (joints, efforts) in known.ends.items()}
    return {"expected": told if known.weight is None else {**told, "weight": round(known.weight, DIGITS)}}


def _pose(name: str, plan: MotionPlan, robot: Robot) -> dict[str, Any]:
    """A free motion of the arm to the wrist pose at the end of a stage; its joints reach it without a collision."""
    joints = _last(plan, ARM, name)
    T = robot.T_world_wrist(joints)
    pose = {"position": _rounded(T[:3, 3]), "orientation_wxyz": _rounded(wxyz(T[:3, :3]))}
    goal = {"pose": pose, "joints": _named(robot.arm_joints, joints)}
    return {"name": name, "type": "MoveTo", "group": ARM, "ik_frame": robot.hand.wrist_link, "goal": goal}


def _straight(name: str, plan: MotionPlan, robot: Robot) -> list[dict[str, Any]]:
    """The straight motion of the wrist in a stage; nothing where it stays."""
    rows = plan.arm.position[plan.part(name)]
    way = robot.T_world_wrist(rows[-1])[:3, 3] - robot.T_world_wrist(rows[0])[:3, 3]
    length = float(np.linalg.norm(way))
    if length < SHORTEST:
        return []
    return [{"name": name, "type": "MoveRelative", "group": ARM, "ik_frame": robot.hand.wrist_link,
             "direction": _rounded(way / length), "distance": round(length, DIGITS)}]


def _named(names: tuple[str, ...], values: Float[np.ndarray, " n"]) -> dict[str, float]:
    return dict(zip(names, _rounded(values), strict=True))


def _rounded(values: Float[np.ndarray, " n"]) -> list[float]:
    return (np.round(values, DIGITS) + 0.0).tolist()
