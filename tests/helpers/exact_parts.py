"""Whether the convex parts of an object are the object, by probes on both sides of its surface."""

from __future__ import annotations

import igl
import numpy as np
import pytest
import trimesh

from dro_grasp.objects.shape import ObjectModel

OUTSIDE = 1e-4  # How far a part may reach out of the mesh [m]
NEAR = 5e-5  # Distance of probes from the surface, on both sides [m]


def mesh_of(obj: ObjectModel) -> trimesh.Trimesh:
    return trimesh.Trimesh(obj.vertices, obj.faces, process=False)


def inside_mesh(obj: ObjectModel, points: np.ndarray) -> np.ndarray:
    """By the exact winding number, a sum over all triangles."""
    return igl.winding_number(obj.vertices, obj.faces.astype(np.int64), points) > 0.5


def depth_in_parts(obj: ObjectModel, points: np.ndarray) -> np.ndarray:
    """How deep each point is in the part that it is deepest in [m], by the planes of its hull."""
    depth = np.full(len(points), -np.inf)
    for vertices, _ in obj.parts:
        hull = trimesh.convex.convex_hull(vertices)
        offsets = (hull.face_normals * hull.triangles[:, 0]).sum(1)
        depth = np.maximum(depth, (offsets - points @ hull.face_normals.T).min(1))
    return depth


def volume_of_union(parts: tuple) -> float:
    return trimesh.boolean.union([trimesh.convex.convex_hull(v) for v, _ in parts], engine="manifold").volume


def require_exact_parts(obj: ObjectModel) -> None:
    """Fail where a part is missing, or reaches out of the object."""
    mesh = mesh_of(obj)
    places, face = trimesh.sample.sample_surface(mesh, 1500, seed=1)
    normals = mesh.face_normals[face]
    low, high = mesh.bounds
    everywhere = np.random.default_rng(0).uniform(low - 0.002, high + 0.002, (1500, 3))
    points = np.concatenate([places + NEAR * normals, places - NEAR * normals, everywhere])
    inside, depth = inside_mesh(obj, points), depth_in_parts(obj, points)
    assert inside[len(places): 2 * len(places)].mean() > 0.99, "half of the probes lie just inside"
    np.testing.assert_array_equal(inside, depth > 0)
    corners = np.concatenate([vertices for vertices, _ in obj.parts])
    distance = np.sqrt(igl.point_mesh_squared_distance(corners, obj.vertices, obj.faces.astype(np.int64))[0])
    assert not ((distance > OUTSIDE) & ~inside_mesh(obj, corners)).any()
    assert volume_of_union(obj.parts) == pytest.approx(obj.volume, rel=1e-4)
