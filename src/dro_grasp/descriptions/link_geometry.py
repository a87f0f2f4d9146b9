"""The shapes of a hand's links, as triangles in the link frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from jaxtyping import Float, Int

from dro_grasp.descriptions.tree_reading import quaternion_matrix

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True)
class LinkGeometry:
    """One shape of one link."""

    link: int
    """Index of the link in the kinematic tree."""
    vertices: Float[np.ndarray, "n 3"]
    """In the link frame [m]."""
    faces: Int[np.ndarray, "m 3"]
    """Vertex indices, counter-clockwise from outside."""
    collides: bool
    """Whether it collides in MuJoCo; the mesh of a colliding shape is its convex hull, which MuJoCo uses."""
    visual: bool
    """Whether it is drawn."""


def read_geometry(model: mujoco.MjModel, link_of_body: dict[int, int]) -> tuple[LinkGeometry, ...]:
    """All shapes of a compiled model whose bodies are links, given the link index by body index."""
    visual_bodies = {int(model.geom_bodyid[g]) for g in range(model.ngeom) if not _collides(model, g)}
    shapes = []
    for g in range(model.ngeom):
        body = int(model.geom_bodyid[g])
        if body not in link_of_body:
            continue
        collides = _collides(model, g)
        mesh = _mesh_of(model, g, hull=collides)
        if mesh is None:
            continue
        rotation, position = quaternion_matrix(model.geom_quat[g]), model.geom_pos[g]
        vertices = np.asarray(mesh.vertices) @ rotation.T + position
        visual = not collides or body not in visual_bodies
        shapes.append(LinkGeometry(link_of_body[body], vertices, np.asarray(mesh.faces), collides, visual))
    return tuple(shapes)


def _collides(model: mujoco.MjModel, g: int) -> bool:
    return bool(model.geom_contype[g] or model.geom_conaffinity[g])


def _mesh_of(model: mujoco.MjModel, g: int, hull: bool) -> trimesh.Trimesh | None:
    """The geom as triangles in its own frame; None for planes and height fields."""
    import trimesh

    kind, size = int(model.geom_type[g]), model.geom_size[g]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        i = int(model.geom_dataid[g])
        vertices = model.mesh_vert[model.mesh_vertadr[i] :][: model.mesh_vertnum[i]]
        faces = model.mesh_face[model.mesh_faceadr[i] :][: model.mesh_facenum[i]]
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        return trimesh.convex.convex_hull(mesh) if hull else mesh
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return trimesh.creation.icosphere(subdivisions=2, radius=size[0])
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return trimesh.creation.capsule(height=2 * size[1], radius=size[0], count=(16, 16))
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return trimesh.creation.icosphere(subdivisions=2).apply_scale(size)
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=24)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return trimesh.creation.box(extents=2 * size)
    return None
