"""Signed distances of points to meshes and to bare clouds, and grids of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import map_coordinates, maximum_filter, minimum_filter
from scipy.spatial import KDTree

from dro_grasp.geometry.cache import Arrays

GRID_SPACING = 0.003  # Spacing of a grid of signed distances [m] (ours)
GRID_PADDING = 0.04  # Distance that the grid extends beyond the object [m] (ours)
LARGEST_GRID = 8_000_000  # Most grid points; a larger object gets a wider spacing (ours)
EXACT_GRID = 2_000_000  # Most points of a grid each of which is computed (ours); of larger ones, those near the surface are
MOST_EXACT = 1_000_000
"""Most of these points (ours): a surface that fills its box gets a wider spacing. Winding numbers of a soup take 15 us each."""
NEAR = 0.008
"""Distance from a surface up to which a grid that is filled coarsely far away is as exact as one that is not [m] (ours)."""
LEAST_WIDENING = 1.05  # Least factor by which it gets wider at once (ours)
STRIDE = 3  # Grid points of such a grid, per axis, for each that is computed far away (ours)
DISC_NEIGHBOURS = 7  # Points of a bare cloud within the disc around each point, itself included (ours)

Distances = Callable[[Float[np.ndarray, "_ 3"]], Float[np.ndarray, " _"]]  # Signed distances of points to one surface [m]


def bake_grid(surface: Float[np.ndarray, "n 3"], distance: Distances, banded: bool = False) -> Arrays:
    """Signed distances on a grid around a surface: `values` (nx ny nz), `origin` (3) and `spacing` [m]; see `banded_values`."""
    low, high = surface.min(0) - GRID_PADDING, surface.max(0) + GRID_PADDING
    spacing = max(GRID_SPACING, float((np.prod(high - low) / LARGEST_GRID) ** (1 / 3)))
    counts = _counts(high - low, spacing)
    if not banded and np.prod(counts) <= EXACT_GRID:
        values = distance(_places(low, counts, spacing))
    else:
        while (count := int((band := _band(distance, low, counts, spacing)).exact.sum())) > MOST_EXACT:
            spacing *= max(LEAST_WIDENING, (count / MOST_EXACT) ** (1 / 3))
            counts = _counts(high - low, spacing)
        values = _filled(band, distance, low, counts, spacing)
    return {"values": values.reshape(counts).astype(np.float32), "origin": low, "spacing": np.array(spacing)}


def _counts(extents: Float[np.ndarray, "3"], spacing: float) -> Int[np.ndarray, "3"]:
    return np.ceil(extents / spacing).astype(int) + 1


def banded_values(
    distance: Distances, low: Float[np.ndarray, "3"], counts: Int[np.ndarray, "3"], spacing: float
) -> Float[np.ndarray, "nx ny nz"]:
    """Signed distances on a grid, computed where they are below NEAR or change sign, and interpolated elsewhere [m]."""
    return _filled(_band(distance, low, counts, spacing), distance, low, counts, spacing)


class _Band(NamedTuple):
    """Which points of a grid are near a surface."""

    coarse: Float[np.ndarray, "cx cy cz"]  # signed distances of every STRIDE-th point, per axis [m]
    exact: Bool[np.ndarray, " n"]  # the points that are to be computed


def _band(distance: Distances, low: Float[np.ndarray, "3"], counts: Int[np.ndarray, "3"], spacing: float) -> _Band:
    # A distance changes no faster than its point moves: where all corners of a coarse cell are farther away than NEAR and half
    # the cell's diagonal, so is everything in it.
    cells = -(-(counts - 1) // STRIDE)
    coarse = distance(_places(low, cells + 1, STRIDE * spacing)).reshape(cells + 1)
    corner = (slice(1, None),) * 3  # a filter of size 2 looks back: these are the cells
    nearest = minimum_filter(np.abs(coarse), 2)[corner]
    turns = minimum_filter(coarse, 2)[corner] * maximum_filter(coarse, 2)[corner] <= 0
    close = turns | (nearest < NEAR + math.sqrt(3) / 2 * STRIDE * spacing)
    own = np.minimum(np.indices(tuple(counts)).reshape(3, -1) // STRIDE, cells[:, None] - 1)
    return _Band(coarse, close[tuple(own)])


def _filled(
    band: _Band, distance: Distances, low: Float[np.ndarray, "3"], counts: Int[np.ndarray, "3"], spacing: float
) -> Float[np.ndarray, "nx ny nz"]:
    """Distances that are computed in the band, and interpolated elsewhere."""
    index = np.indices(tuple(counts)).reshape(3, -1)
    values = map_coordinates(band.coarse, index / STRIDE, order=1, mode="nearest")
    values[band.exact] = distance(low + spacing * index.T[band.exact])
    return values.reshape(counts)


def _places(low: Float[np.ndarray, "3"], counts: Int[np.ndarray, "3"], spacing: float) -> Float[np.ndarray, "n 3"]:
    return low + spacing * np.indices(tuple(counts)).reshape(3, -1).T


def search_tree(points: Float[np.ndarray, "n 3"]) -> KDTree:
    """For the nearest of some points, from places that may be far from all of them."""
    # Nodes keep the whole of their cells: those that shrink to their points lie alike far before a flat surface, and the search
    # visits most of them, which takes ten times as long.
    return KDTree(points, leafsize=32, compact_nodes=False)  # (ours) half the time that 10 take


def cloud_distances(
    cloud: Float[np.ndarray, "m 3"], normals: Float[np.ndarray, "m 3"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " n"]:
    """Distance of each point to the disc around the nearest point of a cloud [m], negative behind the disc."""
    # Discs are perpendicular to the normals and extend to the neighbours: they close the surface and leave its rims open.
    tree = search_tree(cloud)
    some = cloud[:: max(1, len(cloud) // 256)]
    reach = float(np.median(tree.query(some, k=min(DISC_NEIGHBOURS, len(cloud)))[0][:, -1]))
    index = tree.query(points)[1]
    apart = points - cloud[index]
    height = (apart * normals[index]).sum(1)
    beyond = np.maximum(0, np.linalg.norm(apart - height[:, None] * normals[index], axis=1) - reach)
    return np.where(height < 0, -1.0, 1.0) * np.hypot(height, beyond)


def closed_cloud_distances(
    cloud: Float[np.ndarray, "m 3"], normals: Float[np.ndarray, "m 3"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " n"]:
    """As `cloud_distances`, but a rim that is left open, as under an object on a table, is no inside of its own."""
    # Behind the rim's discs a point may be far outside. Away from the surface the winding number of the cloud decides, and
    # beyond the cloud's extent nothing is inside.
    import igl

    distance = cloud_distances(cloud, normals, points)
    count = min(DISC_NEIGHBOURS, len(cloud))
    radius = KDTree(cloud).query(cloud, k=count)[0][:, -1]
    area = np.pi * radius**2 / max(1, count - 1)
    far = np.abs(distance) > 0.003  # [m] (ours): nearer, the disc around the nearest point tells
    distance[far] = np.abs(distance[far])
    deep = far & ((points > cloud.min(0)) & (points < cloud.max(0))).all(1)
    winding = igl.fast_winding_number(cloud, normals, area, np.ascontiguousarray(points[deep]))
    # The winding number is 1/2 where a side of the object is missing.
    distance[deep] *= np.where(np.asarray(winding) > 0.4, -1.0, 1.0)
    return distance


def signed_distances(
    vertices: Float[np.ndarray, "n_vertices 3"], faces: Int[np.ndarray, "n_faces 3"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " n"]:
    """Distance of each point to a mesh [m], negative inside."""
    # Magnitude and sign are computed separately: winding numbers cope with holes, flipped faces and overlapping shells.
    import igl

    corners, triangles = np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64)
    squared = igl.point_mesh_squared_distance(points, corners, triangles)[0]
    winding = igl.fast_winding_number(corners, triangles, points)
    return np.where(np.abs(winding) > 0.5, -1.0, 1.0) * np.sqrt(squared)
