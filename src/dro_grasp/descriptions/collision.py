"""What touches in a configuration of a compiled model."""

from __future__ import annotations

import mujoco


def collide(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Find the contacts at the joint values of `data.qpos`, without any step of time, forces or velocities."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
