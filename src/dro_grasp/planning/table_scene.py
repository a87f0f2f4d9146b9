"""Objects on a table, told apart in the points of a depth camera: the table's plane by a fit, the rest by distance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from dro_grasp.errors import ObjectError
from dro_grasp.objects.loading import cloud_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.planning.robot_file import Table
from dro_grasp.planning.workcell import VOXEL

TRIALS = 300
"""Planes through three points that the fit tries (ours)."""
THICKNESS = 0.006
"""Points at most this far from the plane are the table's [m]: four standard deviations of the noise (ours)."""
STEEPEST = 0.2
"""Largest angle between the table's normal and the world's z axis [rad] (ours)."""
HIGHEST = 0.4
"""Points farther above the table are no object's [m] (ours)."""
NEIGHBOUR = 0.012
"""Points nearer to each other than this are of one object [m] (ours): a camera a metre away has points each 3 mm."""
FEWEST = 60
"""Fewest points of an object (ours)."""
FRAGMENT = 0.05
"""Groups of fewer points than an object has, this near to the one that is wanted, are taken for parts of it [m] (ours)."""
SPECK = 5
"""Groups of fewer points are noise, no obstacles (ours)."""


@dataclass(frozen=True)
class Sight:
    """What a camera sees on a table."""

    points: Float[np.ndarray, "n 3"]
    """Points of the object that is wanted, in the camera's frame [m]."""
    others: Float[np.ndarray, "m 3"]
    """Points of other things on the table, in the world [m]."""
    table_height: float
    """Height of the fitted plane in the middle of the table [m]."""
    places: Float[np.ndarray, "k 2"]
    """Where things stand on the table, the one with most points first: x and y in the world [m]."""

    def obstacles(self) -> list[ObjectModel]:
        """The other things, if there are any, in the world's frame. What is below a point that was seen counts as solid."""
        if not len(self.others):
            return []
        cells, column = np.unique(np.floor(self.others[:, :2] / VOXEL).astype(int), axis=0, return_inverse=True)
        tops = np.full(len(cells), -np.inf)
        np.maximum.at(tops, column.ravel(), self.others[:, 2])
        heights = [np.arange(top, min(self.table_height, top - VOXEL), -VOXEL) for top in tops]
        rows = [np.column_stack([np.tile((cell + 0.5) * VOXEL, (len(z), 1)), z])
                for cell, z in zip(cells, heights, strict=True)]
        return [cloud_object("other things", np.concatenate(rows), origin="other things", keep_table=True)]


def pick_object(
    points: Float[np.ndarray, "n 3"], T_world_camera: Float[np.ndarray, "4 4"], table: Table,
    near: tuple[float, float] | None = None, mask: Bool[np.ndarray, " n"] | None = None,
) -> Sight:
    """Find the table in a camera's points, remove it, and pick one of the objects on it.

    Objects are told apart by distance: two that are less than 12 mm apart count as one, unless a mask is given.

    Args:
        points: In the camera's frame [m].
        T_world_camera: The camera's pose [m].
        table: Where the robot expects its table.
        near: A place in the world near the object that is wanted [m]; the one with most points if omitted.
        mask: Which points belong to the object that is wanted.

    Raises:
        ObjectError: There is no level plane, nothing stands on it, or the mask has nothing of it.
    """
    world = points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    inside = (np.abs(world[:, :2] - table.centre) < np.array(table.size) / 2).all(1)
    normal, offset = fit_plane(world[inside])
    height = world @ normal - offset
    kept = inside & (height > THICKNESS) & (height < HIGHEST)
    middle = (offset - normal[:2] @ np.array(table.centre)) / normal[2]
    points, world, group = points[kept], world[kept], clusters(world[kept])
    sizes = np.bincount(group) if len(group) else np.zeros(1, int)
    if sizes.max() < FEWEST:
        raise ObjectError(f"nothing stands on the table: {int(sizes.max())} points are left after its plane is removed; put "
                          "the object into the camera's view, or correct the camera's pose in the robot file")
    large = [int(g) for g in (-sizes).argsort(kind="stable") if sizes[g] >= FEWEST]
    places = np.stack([world[group == g, :2].mean(0) for g in large])
    if mask is not None:
        wanted = mask[kept]
        if wanted.sum() < FEWEST:
            raise ObjectError(f"the mask has {int(wanted.sum())} points above the table, and at least {FEWEST} are needed; "
                              "give one that is true on the object")
    else:
        nearest = 0 if near is None else int(np.linalg.norm(places - near, axis=1).argmin())
        wanted = group == large[nearest]
    fragment = (sizes[group] < FEWEST) & (KDTree(world[wanted]).query(world)[0] < FRAGMENT)
    others = ~wanted & ~fragment & (sizes[group] >= SPECK)
    return Sight(points[wanted], world[others], float(middle), places)


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
