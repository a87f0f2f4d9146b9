"""The robot and what stands around it, as one MuJoCo specification: for collision checks, and for lifts with physics."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float, Int

from dro_grasp.objects.scenery import one_per_cell
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.planning.robot import Robot
from dro_grasp.planning.robot_file import Table
from dro_grasp.simulation.hand_part import HULL_VERTICES, attach, hand_spec, let_touch
from dro_grasp.simulation.protocols import Protocol

ARM = "arm/"
"""Prefix of the arm's names."""
TABLE = "table"
"""Name of the table."""
TABLE_THICKNESS = 0.05
"""[m] (ours)"""
VOXEL = 0.01
"""Edge of the cells that a cloud of obstacles fills [m] (ours)."""


def robot_spec(robot: Robot, protocol: Protocol, table: Table | None) -> mujoco.MjSpec:
    """Arm, hand and table; nothing drives them yet."""
    scene = mujoco.MjSpec()
    option = scene.option
    option.timestep, option.impratio, option.noslip_iterations = protocol.timestep, protocol.impratio, protocol.noslip
    option.integrator, option.cone = mujoco.mjtIntegrator.mjINT_IMPLICITFAST, mujoco.mjtCone.mjCONE_ELLIPTIC
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE  # the sparse Newton solver of MuJoCo 4.0.0 can be wrong
    arm = robot.arm.spec()
    for mesh in arm.meshes:
        mesh.maxhullvert = HULL_VERTICES
    for geom in arm.geoms:
        let_touch(geom)
    attach(scene, arm, placed_frame(scene.worldbody, robot.T_world_base), ARM)
    attach(scene, hand_spec(robot.hand, protocol), placed_frame(scene.body(ARM + robot.mount_link), robot.T_link_wrist))
    if table is not None:
        half = [table.size[0] / 2, table.size[1] / 2, TABLE_THICKNESS / 2]
        scene.worldbody.add_geom(
            name=TABLE, type=mujoco.mjtGeom.mjGEOM_BOX, size=half, rgba=[0.82, 0.80, 0.76, 1],
            pos=[*table.centre, table.height - TABLE_THICKNESS / 2], friction=[protocol.friction, 0.005, 1e-4])
    return scene


def arm_addresses(model: mujoco.MjModel, robot: Robot) -> Int[np.ndarray, " n_arm"]:
    """Addresses in qpos of the arm's joints in a scene."""
    return np.array([model.jnt_qposadr[model.joint(ARM + name).id] for name in robot.arm_joints])


def placed_frame(body: mujoco.MjsBody, T: Float[np.ndarray, "4 4"]) -> mujoco.MjsFrame:
    """A frame of a body at a pose [m]."""
    return body.add_frame(pos=T[:3, 3], quat=wxyz(T[:3, :3]))


def wxyz(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """Unit quaternion WXYZ of a rotation."""
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.asarray(R, np.float64).ravel())
    return quaternion / np.linalg.norm(quaternion)


def add_solids(scene: mujoco.MjSpec, body: mujoco.MjsBody, things: Sequence[ObjectModel], hull: bool = False) -> None:
    """Shapes of things in a body's frame: convex parts of meshes; of clouds, small boxes, or with `hull` the convex hull."""
    for i, thing in enumerate(things):
        if thing.is_cloud and not hull:
            for centre, half in zip(*occupied(thing.cloud.astype(np.float64)), strict=True):
                body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=centre)
            continue
        corners = [thing.cloud] if thing.is_cloud else [vertices for vertices, _ in thing.parts]
        for j, vertices in enumerate(corners):
            mesh = scene.add_mesh(name=f"{body.name}-solid{i}.{j}", uservert=np.asarray(vertices, np.float64).ravel())
            mesh.maxhullvert = HULL_VERTICES
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name)


def occupied(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"]]:
    """Centres and half edges [m] of boxes that together are the cells of size VOXEL that hold a point."""
    low = np.floor(points[one_per_cell(points, VOXEL)] / VOXEL).astype(int)
    high = low + 1
    for axis in (2, 1, 0):  # boxes next to each other along an axis, and alike in the others, become one
        alike = np.delete(np.concatenate([low, high], 1), (axis, axis + 3), axis=1)
        order = np.lexsort((low[:, axis], *alike.T))
        low, high, alike = low[order], high[order], alike[order]
        apart = (alike[1:] != alike[:-1]).any(1) | (low[1:, axis] != high[:-1, axis])
        first = np.flatnonzero(np.r_[True, apart])
        last = np.r_[first[1:], len(low)] - 1
        low, high = low[first], np.where(np.arange(3) == axis, high[last], high[first])
    return (low + high) * (VOXEL / 2), (high - low) * (VOXEL / 2)
