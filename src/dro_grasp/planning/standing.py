"""Objects as they stand in the world: turned until their z axis points up, as constraints on grasps want them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from dro_grasp.geometry.table_plane import moved_plane
from dro_grasp.objects.cache import content_hash
from dro_grasp.objects.shape import ObjectModel

UPRIGHT = 1e-6
"""Largest deviation of an upright object's z axis from the world's (ours)."""


def upright(
    obj: ObjectModel, T_world_object: Float[np.ndarray, "4 4"]
) -> tuple[ObjectModel, Float[np.ndarray, "4 4"]]:
    """The same object in the same place, with a frame whose z axis points up."""
    if np.abs(T_world_object[2, :3] - (0, 0, 1)).max() < UPRIGHT:
        return obj, T_world_object
    turn, stand = np.eye(4), np.eye(4)
    turn[:3, :3], stand[:3, 3] = T_world_object[:3, :3], T_world_object[:3, 3]
    return moved(obj, turn), stand


def moved(obj: ObjectModel, T: Float[np.ndarray, "4 4"]) -> ObjectModel:
    """The same object, with coordinates in another frame."""
    R, t = T[:3, :3], T[:3, 3]
    cloud, normals = (obj.cloud @ R.T + t).astype(np.float32), (obj.cloud_normals @ R.T).astype(np.float32)
    vertices = None if obj.vertices is None else obj.vertices @ R.T + t
    faces = np.zeros((0, 3), np.int32) if obj.faces is None else obj.faces
    shape = cloud if vertices is None else vertices
    table = None if obj.table is None else moved_plane(obj.table, T)
    seen = None if obj.seen is None else (obj.seen @ R.T + t).astype(np.float32)
    return replace(
        obj, cloud=cloud, cloud_normals=normals, vertices=vertices, centre_of_mass=R @ obj.centre_of_mass + t,
        inertia=R @ obj.inertia @ R.T, sha256=content_hash(shape.astype(np.float32), faces.astype(np.int32)),
        seen=seen, table=table, balls=None, exact_parts=None if obj.is_cloud else tuple((v @ R.T + t, f) for v, f in obj.parts))
