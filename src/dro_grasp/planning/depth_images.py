"""What the robot's camera sees: depth by rays, with noise; the table's plane by fit; and the points of the object."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from dro_grasp.errors import ObjectError
from dro_grasp.perception.scan import depth_points
from dro_grasp.planning.physics import SHAPE_GROUP, LiftScene
from dro_grasp.planning.robot_file import CameraMount, Table
from dro_grasp.simulation.scene import PREFIX

STRIDE = 2
"""Every so many pixels, in both directions, one ray is cast (ours)."""
FARTHEST = 3.0
"""Longest ray [m] (ours)."""
TRIALS = 300
"""Planes through three points that the fit tries (ours)."""
THICKNESS = 0.006
"""Points at most this far from the plane are the table's [m]: four standard deviations of the noise (ours)."""
STEEPEST = 0.2
"""Largest angle between the table's normal and the world's z axis [rad] (ours)."""
HIGHEST = 0.4
"""Points farther above the table are no object's [m] (ours)."""
NEIGHBOUR = 0.02
"""Points nearer to each other than this are of one object [m] (ours)."""
FEWEST = 60
"""Fewest points of an object (ours)."""


@dataclass(frozen=True)
class Sight:
    """What is left of a depth image."""

    points: Float[np.ndarray, "n 3"]
    """Points of one object in the camera's frame [m]."""
    others: Float[np.ndarray, "m 3"]
    """Points of other things on the table, in the world [m]."""
    table_height: float
    """Height of the fitted plane in the middle of the table [m]."""


def depth_image(scene: LiftScene, camera: CameraMount, noise: float, seed: int) -> Float[np.ndarray, "h w"]:
    """Depth along the camera's z axis [m]; zero where there is none, and where the robot's model covers the view.

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
    robot = np.array([name.startswith(("arm/", PREFIX)) for name in owner])
    seen = (geom >= 0) & (distance > 0) & ~robot[np.maximum(geom, 0)]
    drawn = np.random.default_rng(seed).normal(0.0, noise, len(rays))
    return np.where(seen, distance / length + drawn, 0.0).reshape(row.shape)


def look(depth: Float[np.ndarray, "h w"], camera: CameraMount, table: Table, near: tuple[float, float] | None = None) -> Sight:
    """Find the table in a depth image, and on it one object.

    Args:
        depth: From `depth_image`, or from a camera, by STRIDE in both directions [m].
        camera: Pose and intrinsics.
        table: Where the robot expects its table.
        near: A place in the world near the object that is wanted [m]; the largest object if omitted.

    Raises:
        ObjectError: There is no level plane, or nothing stands on it.
    """
    scaled = camera.intrinsics / np.array([[STRIDE], [STRIDE], [1.0]])
    points = depth_points(depth, scaled)
    T = camera.T_world_camera
    world = points @ T[:3, :3].T + T[:3, 3]
    half = np.array(table.size) / 2
    inside = (np.abs(world[:, :2] - table.centre) < half).all(1)
    points, world = points[inside], world[inside]
    normal, offset = fit_plane(world)
    height = world @ normal - offset
    kept = (height > THICKNESS) & (height < HIGHEST)
    group = clusters(world[kept])
    sizes = np.bincount(group) if len(group) else np.zeros(1, int)
    if sizes.max() < FEWEST:
        raise ObjectError(f"nothing stands on the table: {int(sizes.max())} points are left after its plane is removed; put "
                          "the object into the camera's view, or correct the camera's pose in the robot file")
    large = np.flatnonzero(sizes >= FEWEST)
    chosen = int(sizes.argmax()) if near is None else int(
        min(large, key=lambda g: float(np.linalg.norm(world[kept][group == g, :2].mean(0) - near))))
    middle = (offset - normal[:2] @ np.array(table.centre)) / normal[2]
    return Sight(points[kept][group == chosen], world[kept][group != chosen], float(middle))


def fit_plane(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "3"], float]:
    """Upward unit normal, and offset along it, of the level plane that most points lie on [m].

    Raises:
        ObjectError: There is none. Source of the scheme: RANSAC, Fischler and Bolles 1981, then least squares.
    """
    random, best = np.random.default_rng(0), np.zeros(len(points), bool)
    for _ in range(TRIALS if len(points) >= 3 else 0):
        a, b, c = points[random.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        if abs(normal[2]) < np.cos(STEEPEST) * np.linalg.norm(normal) or not np.linalg.norm(normal):
            continue
        near = np.abs((points - a) @ normal) < THICKNESS / 2 * np.linalg.norm(normal)
        best = near if near.sum() > best.sum() else best
    if best.sum() < FEWEST:
        raise ObjectError("the camera sees no level table; correct its pose in the robot file, or the table's place")
    normal, offset = _least_squares(points[best])
    for _ in range(2):
        normal, offset = _least_squares(points[np.abs(points @ normal - offset) < THICKNESS / 2])
    return normal, offset


def _least_squares(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "3"], float]:
    middle = points.mean(0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    normal = normal * np.sign(normal[2])
    return normal, float(normal @ middle)


def clusters(points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Number of the connected group of each point; neighbours are closer than NEIGHBOUR."""
    pairs = KDTree(points).query_pairs(NEIGHBOUR, output_type="ndarray") if len(points) else np.zeros((0, 2), int)
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    return connected_components(graph, directed=False)[1] if len(points) else np.zeros(0, int)
