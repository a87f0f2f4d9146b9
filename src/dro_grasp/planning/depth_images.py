"""What the robot's camera sees of a simulated scene: depth by rays, with noise, and which pixels show an object."""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from dro_grasp.planning.physics import SHAPE_GROUP, LiftScene, object_name
from dro_grasp.planning.robot_file import CameraMount
from dro_grasp.planning.workcell import ARM
from dro_grasp.simulation.hand_part import PREFIX

STRIDE = 2
"""Every so many pixels, in both directions, one ray is cast (ours)."""
FARTHEST = 3.0
"""Longest ray [m] (ours)."""


def thinned_intrinsics(camera: CameraMount) -> Float[np.ndarray, "3 3"]:
    """Those of the images that `depth_image` makes, whose pixels are STRIDE apart [pixels]."""
    return camera.intrinsics / np.array([[STRIDE], [STRIDE], [1.0]])


def depth_image(
    scene: LiftScene, camera: CameraMount, noise: float, seed: int
) -> tuple[Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Depth along the camera's z axis [m], and which pixels show the scene's first object.

    Depth is zero where nothing is near, and where the robot's model covers the view.

    Args:
        scene: Its objects are seen as their true meshes.
        camera: Pose and intrinsics.
        noise: Standard deviation of depth [m].
        seed: Of the noise.
    """
    row, column = np.meshgrid(np.arange(0, camera.height, STRIDE), np.arange(0, camera.width, STRIDE), indexing="ij")
    pixels = np.stack([column, row, np.ones_like(row)], -1).reshape(-1, 3).astype(float)
    rays = np.linalg.solve(camera.intrinsics, pixels.T).T
    length = np.linalg.norm(rays, axis=1)
    world = (rays / length[:, None]) @ camera.T_world_camera[:3, :3].T
    groups = np.array([1, 1, 1, 0, 1, 0], np.uint8)  # true shapes in, convex parts out
    assert groups[SHAPE_GROUP]
    geom, distance = np.full(len(rays), -1, np.int32), np.full(len(rays), -1.0)
    eye = camera.T_world_camera[:3, 3].copy()
    mujoco.mj_multiRay(
        scene.model, scene.data, eye, world.ravel().copy(), groups, True, -1, geom, distance, None, len(rays), FARTHEST)
    owner = [scene.model.body(int(b)).name for b in scene.model.geom_bodyid]
    robot = np.array([name.startswith((ARM, PREFIX)) for name in owner])
    seen = (geom >= 0) & (distance > 0) & ~robot[np.maximum(geom, 0)]
    first = np.array([name == object_name(0) for name in owner])[np.maximum(geom, 0)] & seen
    drawn = np.random.default_rng(seed).normal(0.0, noise, len(rays))
    return np.where(seen, distance / length + drawn, 0.0).reshape(row.shape), first.reshape(row.shape)
