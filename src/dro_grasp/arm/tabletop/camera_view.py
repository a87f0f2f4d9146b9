"""What a robot's depth camera sees of a simulated table."""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from dro_grasp.arm.planning.physics import SHAPE_GROUP, LiftScene, object_name
from dro_grasp.arm.planning.workcell import ARM
from dro_grasp.arm.robots.robot import CameraMount
from dro_grasp.objects.perception.depth_noise import DepthView, depth_noise, measured_depth
from dro_grasp.simulation.scene import PREFIX

REFLECTANCES = (0.1, 0.9)  # Shares of the light that things return, the table among them [1] (ours)


def depth_image(
    scene: LiftScene, camera: CameraMount, noise: float | str, seed: int
) -> tuple[Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Depth along the camera's z axis [m], and which pixels show the scene's first object.

    Depth is zero where nothing is near, and where the robot's model covers the view. Objects are seen as their true meshes.
    `noise` is a preset of `depth_noise`, or the standard deviation of depth [m]. Things are dark or bright by chance.
    """
    row, column = np.meshgrid(np.arange(camera.height), np.arange(camera.width), indexing="ij")
    pixels = np.stack([column, row, np.ones_like(row)], -1).reshape(-1, 3).astype(float)
    rays = np.linalg.solve(camera.intrinsics, pixels.T).T
    length = np.linalg.norm(rays, axis=1)
    world = (rays / length[:, None]) @ camera.T_world_camera[:3, :3].T
    groups = np.array([1, 1, 1, 0, 1, 0], np.uint8)  # true shapes in, convex parts out
    assert groups[SHAPE_GROUP]
    geom, distance, normal = np.full(len(rays), -1, np.int32), np.full(len(rays), -1.0), np.zeros(rays.size)
    eye = camera.T_world_camera[:3, 3].copy()
    mujoco.mj_multiRay(
        scene.model, scene.data, eye, world.ravel().copy(), groups, True, -1, geom, distance, normal, len(rays), 3.0)
    owner = [scene.model.body(int(b)).name for b in scene.model.geom_bodyid]
    robot = np.array([name.startswith((ARM, PREFIX)) for name in owner])
    seen = (geom >= 0) & (distance > 0) & ~robot[np.maximum(geom, 0)]
    first = np.array([name == object_name(0) for name in owner])[np.maximum(geom, 0)] & seen
    light = np.random.default_rng([seed, 1]).uniform(*REFLECTANCES, scene.model.ngeom)[geom]
    view = DepthView(
        np.where(seen, distance / length, 0.0).reshape(row.shape),
        (normal.reshape(-1, 3) @ camera.T_world_camera[:3, :3]).reshape(*row.shape, 3), camera.intrinsics,
        light.reshape(row.shape))
    return measured_depth(view, depth_noise(noise), seed), first.reshape(row.shape)
