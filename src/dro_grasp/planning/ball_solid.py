"""A body for physics from a bare cloud: balls that touch its surface from inside, so that hollows stay hollow. Ours."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import ConvexHull

from dro_grasp.objects.shape import DENSITY, ObjectModel
from dro_grasp.planning.workcell import TABLE
from dro_grasp.simulation.protocols import Protocol
from dro_grasp.simulation.scene import HULL_VERTICES, PREFIX

RADII = (0.008, 0.006, 0.004, 0.003, 0.002)
"""Radii of balls [m]; each point gets the largest that stays inside, or else the smallest (ours)."""
SPACING = 0.008
"""Distance between the points that are touched [m] (ours): between the largest balls the surface is 1 mm low."""
OUTSIDE = 0.0012
"""How far a ball may reach through the surface elsewhere [m] (ours)."""
FOOT = 0.004
"""What an estimated object has this near to its lowest point stands on the table [m] (ours)."""
BALL_BIT = 2
"""Bit of contacts of balls with the hand (ours)."""
HULL_BIT = 4
"""Bit of contacts of the convex hull with the table (ours)."""


@dataclass(frozen=True)
class BallSolid:
    """Balls of n points of a surface, and the inertia of what the surface encloses."""

    centres: Float[np.ndarray, "n 3"]
    """[m]"""
    radii: Float[np.ndarray, " n"]
    """[m]"""
    volume: float
    """[m^3]"""
    centre_of_mass: Float[np.ndarray, "3"]
    """[m]"""
    inertia: Float[np.ndarray, "3 3"]
    """About the centre of mass, at unit density [m^5]."""


def ball_solid(obj: ObjectModel) -> BallSolid:
    """Balls inside a cloud with normals."""
    cloud, normals, field = obj.cloud.astype(float), obj.cloud_normals.astype(float), obj.distance_field
    cells = np.floor(cloud / SPACING)
    order = np.linalg.norm(cloud / SPACING - cells - 0.5, axis=1).argsort(kind="stable")
    rows = order[np.unique(cells[order], axis=0, return_index=True)[1]]  # the point nearest to the middle of each cell
    points, normals = cloud[rows], normals[rows]
    candidates = points - np.array(RADII)[:, None, None] * normals
    inside = -field.distances(torch.from_numpy(candidates).float())[0].numpy() > np.array(RADII)[:, None] - OUTSIDE
    inside[-1] = True
    largest = inside.argmax(0)
    cell = field.spacing**3
    grid = np.indices(field.shape).reshape(3, -1).T[field.slopes[:, 0].numpy() < 0] * field.spacing + field.origin.numpy()
    if not len(grid):
        grid = cloud
    centre = grid.mean(0)
    apart = grid - centre
    products = cell * apart.T @ apart
    return BallSolid(
        candidates[largest, np.arange(len(points))], np.array(RADII)[largest], cell * len(grid), centre,
        np.trace(products) * np.eye(3) - products + 1e-12 * np.eye(3))


def add_ball_object(scene: mujoco.MjSpec, obj: ObjectModel, protocol: Protocol, name: str) -> None:
    """A bare cloud as a body with a free joint, of the density of trials, on a scene with a hand and a table.

    The hand touches the balls; on the table stands the convex hull, with a flat foot, so that what was seen stays put.
    """
    solid, board = ball_solid(obj), scene.geom(TABLE)
    body = scene.worldbody.add_body(name=name)
    body.add_freejoint(name=name)
    friction = [protocol.friction, protocol.torsional_friction, 1e-4]
    for centre, radius in zip(solid.centres, solid.radii, strict=True):
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], pos=centre, condim=4, friction=friction, mass=0.0,
                      contype=BALL_BIT, conaffinity=BALL_BIT)
    cloud, height = obj.cloud.astype(float), float(board.pos[2] + board.size[2])
    foot = cloud[cloud[:, 2] < cloud[:, 2].min() + FOOT] * (1, 1, 0) + (0, 0, height)
    corners = np.concatenate([cloud, foot])
    mesh = scene.add_mesh(name=f"{name}hull", uservert=corners[ConvexHull(corners).vertices].ravel())
    mesh.maxhullvert = HULL_VERTICES
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, condim=4, friction=friction, mass=0.0, contype=HULL_BIT,
                  conaffinity=HULL_BIT)
    hand = [geom for geom in scene.geoms if geom.parent is not None and geom.parent.name.startswith(PREFIX) and geom.contype]
    for geom, bit in [*((geom, BALL_BIT) for geom in hand), (board, HULL_BIT)]:
        geom.contype, geom.conaffinity = geom.contype | bit, geom.conaffinity | bit
    inertia = DENSITY * solid.inertia
    body.explicitinertial, body.mass, body.ipos = True, DENSITY * solid.volume, solid.centre_of_mass
    body.fullinertia = [inertia[0, 0], inertia[1, 1], inertia[2, 2], inertia[0, 1], inertia[0, 2], inertia[1, 2]]
