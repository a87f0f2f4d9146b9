"""Points and their neighbours: groups that stand apart from one another, as several things in a cloud do, and normals."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import label
from scipy.spatial import KDTree

from dro_grasp.geometry.point_clouds import one_per_cell

CELL = 0.01
"""Edge of the cells of which neighbours belong together [m] (ours): nearer points are one group, twice as far ones two."""
SPACINGS = 2.0  # Distances of neighbours that the edge measures at least [1] (ours), so that sparse clouds stay whole
LEAST_SHARE = 0.05  # Share of the filled cells that is a group (ours); less is what a camera scatters
LEAST_CELLS = 4  # Cells that it fills, at least (ours)
MOST_CELLS = 10**7  # Cells of a box above which the cloud is left as it is (ours)


def separate_groups(points: Float[np.ndarray, "n 3"]) -> list[Int[np.ndarray, " _"]]:
    """Indices of the points of each group [m], the largest first; scattered points are in none."""
    if len(points) < 2:
        return [np.arange(len(points))]
    if np.prod(np.ptp(points, axis=0) / CELL + 1) > MOST_CELLS:
        return [np.arange(len(points))]
    cells = np.floor((points - points.min(0)) / max(CELL, SPACINGS * _spacing(points))).astype(np.int64)
    filled = np.zeros(cells.max(0) + 1, bool)
    filled[tuple(cells.T)] = True
    labels, count = label(filled, np.ones((3, 3, 3)))  # type: ignore[misc]
    sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    own = labels[tuple(cells.T)]
    wanted = [i for i in np.argsort(-sizes, kind="stable") if sizes[i] >= max(LEAST_CELLS, LEAST_SHARE * sizes.sum())]
    return [np.flatnonzero(own == i + 1) for i in wanted]


def _spacing(points: Float[np.ndarray, "n 3"]) -> float:
    """Distance within which nearly every point has two neighbours [m], of a thinned cloud."""
    thin = points[one_per_cell(points, CELL / 4)]
    some = thin[:: max(1, len(thin) // 2000)]
    return float(np.quantile(KDTree(thin).query(some, k=min(3, len(thin)))[0].reshape(len(some), -1)[:, -1], 0.9))


def local_normals(points: Float[np.ndarray, "n 3"], neighbours: int) -> Float[np.ndarray, "n 3"]:
    """Unit normals of a cloud, to no side: the direction in which the neighbours of each point spread least."""
    if len(points) < 3:
        return np.tile([0.0, 0.0, 1.0], (len(points), 1))
    near = points[KDTree(points).query(points, k=min(neighbours, len(points)))[1]]
    local = near - near.mean(1, keepdims=True)
    return np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))[1][:, :, 0]
