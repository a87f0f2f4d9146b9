"""A scene to avoid as the planner takes obstacles: the points of its surface, in whose cells nothing may be."""

from __future__ import annotations

import numpy as np
import trimesh
from jaxtyping import Float

from dro_grasp.objects.cache import content_hash
from dro_grasp.objects.scenery import Scene, one_per_cell
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.planning.workcell import VOXEL

POINTS_PER_CELL = 16
"""Points drawn on a mesh for each square of edge VOXEL (ours): one cell in ten million stays empty."""
MOST_POINTS = 5_000_000
"""Most points drawn on a mesh (ours)."""


def scene_solid(scene: Scene, centre: Float[np.ndarray, "3"], reach: float) -> list[ObjectModel]:
    """What of a scene is within reach of a robot, as one thing; nothing if none of it is.

    Args:
        scene: In the world's frame.
        centre: The robot's base [m].
        reach: How far anything of the robot, and what it carries, gets from there [m].
    """
    points = scene.points
    if scene.faces is not None:
        mesh = trimesh.Trimesh(scene.points, scene.faces, process=False)
        count = min(MOST_POINTS, int(POINTS_PER_CELL * mesh.area / VOXEL**2) + POINTS_PER_CELL)
        points = np.concatenate([points[scene.faces].reshape(-1, 3), trimesh.sample.sample_surface(mesh, count, seed=0)[0]])
    points = points[np.linalg.norm(points - centre, axis=1) < reach]
    if not len(points):
        return []
    cloud = points[one_per_cell(points, VOXEL / 2)].astype(np.float32)
    return [ObjectModel(scene.name, cloud, np.zeros_like(cloud), cloud.mean(0, dtype=np.float64), content_hash(cloud))]
