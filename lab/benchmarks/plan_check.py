"""Stored plans checked again at ten times their resolution, by other means than those that made them.

    python -m lab.benchmarks.plan_check FOLDER [--json]

FOLDER, or a folder in it, holds plans, as `lab.benchmarks.lifts` stores them. Arm, hand and table collide in plain MuJoCo;
fingers and the points of objects and other things by their distance; limits by finite differences between samples.
"""

# MuJoCo 4 exports its names at run time only.
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import torch
from scipy.spatial import KDTree

from dro_grasp.arm.planning.motion import STAGES, MotionPlan
from dro_grasp.arm.planning.workcell import Workcell, arm_addresses, robot_spec
from dro_grasp.arm.robots.loading import load_robot
from dro_grasp.arm.robots.robot import Robot
from dro_grasp.simulation.protocols import PROTOCOLS
from dro_grasp.simulation.scene import joint_addresses
from lab.benchmarks.report import emit, options_of

FINER = 10
"""Configurations that are checked for each sample of a plan (ours)."""
NEAR = 0.01
"""Farther away, distances to things are not measured [m] (ours)."""
TOUCH = 0.001
"""Distance of a point of the hand's surface to a point of a cloud that counts as contact [m] (ours)."""
SLACK = 1.001
"""Factor within which speeds and joints may exceed a limit by rounding (ours)."""
SLOPE = 1.1
"""The same of accelerations, which differences of differences state roughly (ours)."""
COLUMNS = ("robot", "plans", "configurations", "in collision", "beyond a limit", "nearest thing, travelling [mm, at most 10]")
"""Headings."""


class Scene:
    """A robot over a table in plain MuJoCo."""

    def __init__(self, robot: Robot) -> None:
        scene = robot_spec(robot, PROTOCOLS["dro"], robot.table)
        for first, second in Workcell(robot).excluded:
            scene.add_exclude(bodyname1=first, bodyname2=second)
        self.robot, self.model = robot, scene.compile()
        self.data, self.arm = mujoco.MjData(self.model), arm_addresses(self.model, robot)
        self.hand, self.moving = joint_addresses(self.model, robot.hand)

    def collisions(self, arm: np.ndarray, hand: np.ndarray) -> int:
        """In how many of these configurations something but two fingers penetrates."""
        tree, count = self.robot.hand.tree, 0
        full = (hand @ tree.coupling.double().numpy().T + tree.offset.double().numpy())[:, self.moving]
        fingers = np.array([self.model.body(int(b)).name.startswith("hand/") for b in self.model.geom_bodyid])
        for q, joints in zip(arm, full, strict=True):
            self.data.qpos[self.arm], self.data.qpos[self.hand] = q, joints
            mujoco.mj_kinematics(self.model, self.data)
            mujoco.mj_comPos(self.model, self.data)
            mujoco.mj_collision(self.model, self.data)
            deep = self.data.contact.geom[self.data.contact.dist < 0]
            count += bool((~fingers[deep].all(1)).any())
        return count


def beyond_limits(made: MotionPlan, robot: Robot) -> bool:
    """Whether a joint leaves its range, or arm or hand move or speed up more than they may."""
    parts = ((made.arm, robot.velocity, robot.acceleration, robot.lower, robot.upper),
             (made.hand, robot.hand_velocity, robot.hand_acceleration, robot.hand.tree.lower.numpy() - 1e-6,
              robot.hand.tree.upper.numpy() + 1e-6))
    for part, velocity, acceleration, lower, upper in parts:
        step = np.diff(part.time)[:, None]
        speed = np.diff(part.position, axis=0) / step
        change = np.diff(speed, axis=0) / ((step[1:] + step[:-1]) / 2)
        outside = (part.position < lower) | (part.position > upper)
        if outside.any() or (np.abs(speed) > SLACK * velocity).any() or (np.abs(change) > SLOPE * acceleration).any():
            return True
    return False


def nearest(made: MotionPlan, robot: Robot, arm: np.ndarray, hand: np.ndarray, stage: np.ndarray) -> float:
    """Least distance of the travelling hand to points of the object, and of the hand at any time to those of others [m]."""
    points = robot.hand.points(torch.from_numpy(hand).float(), torch.from_numpy(robot.T_world_wrist(arm)).float()).numpy()
    travelling = points[stage <= STAGES.index("shape")].reshape(-1, 3)
    least = NEAR
    for cloud, mine in ((made.scene.points, travelling), (made.scene.others, points.reshape(-1, 3))):
        if len(cloud):
            least = min(least, float(KDTree(cloud).query(mine, distance_upper_bound=least)[0].min()))
    return least


def main() -> None:
    """Check and print."""
    parser = options_of(__doc__)
    parser.add_argument("folder", type=Path)
    arguments = parser.parse_args()
    found: dict[str, list[tuple[int, int, bool, float]]] = {}
    scenes: dict[tuple[str, float | None], Scene] = {}
    for path in sorted(arguments.folder.rglob("*.npz")):
        made = MotionPlan.load(path)
        key = made.notes.robot, made.notes.table
        if key not in scenes:
            robot = load_robot(made.notes.robot)
            table = None if robot.table is None or key[1] is None else replace(robot.table, height=key[1])
            scenes[key] = Scene(replace(robot, table=table))
        time = np.linspace(0, made.seconds, FINER * len(made.arm.time))
        stage = made.stage[np.searchsorted(made.arm.time, time).clip(max=len(made.stage) - 1)]
        arm, hand = (np.stack([np.interp(time, t.time, c) for c in t.position.T], 1) for t in (made.arm, made.hand))
        robot = scenes[key].robot
        near = nearest(made, robot, arm, hand, stage)
        wrong = scenes[key].collisions(arm, hand) + (near < TOUCH)
        found.setdefault(robot.name, []).append((len(time), wrong, beyond_limits(made, robot), near))
    rows = [[name, len(rows), sum(r[0] for r in rows), sum(r[1] > 0 for r in rows), sum(r[2] for r in rows),
             round(1e3 * min(r[3] for r in rows), 1)] for name, rows in found.items()]
    emit("Plans checked at ten times their resolution", rows, COLUMNS,
         {"rows": [dict(zip(COLUMNS, r, strict=True)) for r in rows]}, arguments.json)


if __name__ == "__main__":
    main()
