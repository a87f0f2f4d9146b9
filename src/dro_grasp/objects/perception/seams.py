"""Things that touch, parted where the surface turns inward or breaks off between two parts that each stand by themselves."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, KDTree, QhullError

CONCAVE = 0.35  # Sine of the angle between normals that turn towards each other at a seam [1] (ours)
BREAK = 1.5  # Distance of neighbours across a gap, in cubes or usual distances [1] (ours): on an even surface they are nearer
ACROSS = 0.6  # Cosine between a gap and the ray to it below which it is seen across [1] (ours)
WALL = 0.008  # Distance from an upright cut within which a seam runs along it [m] (ours)
ALONG = 0.75  # Share of the seam's cubes that do, at least (ours)
SHARED = 0.9  # Most cubes beside the seam that it may cut through, over those of the seam [1] (ours)
TALL = 0.02  # Least height of such a seam [m] (ours)
BROAD = 0.0015  # Its least area [m^2] (ours): smaller ones run over single things, too
CUTS = 24  # Directions of upright cuts that are tried (ours)
PART = 0.1  # Share of a thing that each side of a seam has, at least [1] (ours)
LEAST_PART = 24  # Filled cubes of each, at least (ours): as of a thing
FOOT = 0.03  # Height above a plane up to which a part is seen to stand on it [m] (ours): cubes below 2 cm may be the plane's
ASIDE = 0.008  # Cubes nearer to each other along the plane are above one another [m] (ours)
FREE = 0.3  # Share of the places below a part that may be seen to be free, if its foot is hidden [1] (ours)
BELOW = (0.25, 0.5, 0.75, 0.95)  # Those places, as shares of the way down to the plane [1] (ours)
BEHIND = 0.01  # What is at least so far behind a place does not hide it [m] (ours)
INSIDE = 0.003  # Depth from which a point is inside another part's hull [m] (ours)
WITHIN = 0.03  # Share of a part that is inside another one of the same thing [1] (ours): two walls of a bowl


@dataclass(frozen=True, eq=False)
class Surface:
    """Averaged points that a camera saw, without the planes on which things stand."""

    cells: Float[np.ndarray, "r 3"]
    """Means of the points in each filled cube [m]."""
    normals: Float[np.ndarray, "r 3"]
    """Unit normals, to the camera."""
    camera: Float[np.ndarray, "3"]
    """Its place [m]."""
    edge: float
    """Edge of the cubes [m]."""
    pairs: Int[np.ndarray, "p 2"]
    """Neighbours."""

    @cached_property
    def rays(self) -> tuple[KDTree, Float[np.ndarray, " r"]]:
        """Search tree of the unit directions in which the camera saw the cells, and how far away they are [m]."""
        rays = self.cells - self.camera
        far = np.linalg.norm(rays, axis=1)
        return KDTree(rays / far[:, None]), far


def joined(pairs: Int[np.ndarray, "p 2"], count: int) -> Int[np.ndarray, " count"]:
    """The group of each of `count` rows, of which the pairs join some."""
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def parted(
    surface: Surface, own: Int[np.ndarray, " o"], levels: list[Float[np.ndarray, "4"]]
) -> tuple[Int[np.ndarray, " o"], bool]:
    """Which of the things that may touch each cube of a thing is, numbered from 0; and whether any seam or gap runs over it.

    Parts that a seam divides may be things of their own if at least two of them reach down to a plane, or may do so out of
    sight, and they are not within each other. The concave edges are those of Stein et al. 2014; the rest is ours.
    """
    sides = _sides(surface, own, levels)
    return (_standing(surface, own, _beside(surface.cells[own], sides), levels), True) if sides.any() else (sides, False)


def _sides(
    surface: Surface, own: Int[np.ndarray, " o"], levels: list[Float[np.ndarray, "4"]]
) -> Int[np.ndarray, " o"]:
    """The parts into which a thing falls where its surface turns inward, or breaks off."""
    place = np.full(len(surface.cells), -1)
    place[own] = np.arange(len(own))
    mine = place[surface.pairs[(place[surface.pairs] >= 0).all(1)]]
    cells, normals = surface.cells[own], surface.normals[own]
    i, j = mine.T
    between = cells[j] - cells[i]
    apart = np.linalg.norm(between, axis=1)
    between = between / np.maximum(apart, 1e-9)[:, None]
    # Normals of a convex surface turn away from each other, those at a seam towards each other.
    inward = ((normals[i] - normals[j]) * between).sum(1)
    seam = np.bincount(mine[inward > CONCAVE].ravel(), minlength=len(own)) > 0
    # A camera sees a gap between things across its rays; along them, a surface hides a part of itself.
    rays = cells[i] - surface.camera
    along = np.abs((rays * between).sum(1)) / np.linalg.norm(rays, axis=1)
    usual = float(np.median(KDTree(cells).query(cells, k=2)[0][:, 1]))  # of thinned clouds it is more than a cube
    gap = (apart > BREAK * max(surface.edge, usual)) & (along < ACROSS)
    for joins in (~gap, ~seam[mine].any(1)):
        part = joined(mine[joins], len(own))
        large = np.flatnonzero(np.bincount(part) >= max(PART * len(own), LEAST_PART))
        if len(large) > 1:
            return _nearest(cells, part, large)
    run = joined(mine[seam[mine].all(1)], len(own))
    longest = seam & (run == np.bincount(run, seam).argmax())
    return _cut(cells, longest, levels) if longest.sum() * surface.edge**2 > BROAD else np.zeros(len(own), int)


def _cut(
    cells: Float[np.ndarray, "o 3"], seam: Bool[np.ndarray, " o"], levels: list[Float[np.ndarray, "4"]]
) -> Int[np.ndarray, " o"]:
    """The two sides of an upright cut along a seam, which ends where faces of two things lie in line."""
    whole = np.zeros(len(cells), int)
    if not levels or np.ptp(cells[seam] @ (up := levels[0][:3])) < TALL:
        return whole
    flat = cells @ np.linalg.svd(up[None])[2][1:].T
    angle = np.pi * np.arange(CUTS) / CUTS
    off = (flat - np.median(flat[seam], axis=0)) @ np.stack([np.cos(angle), np.sin(angle)])
    near = np.abs(off) < WALL
    # Where least else is cut: two things share less than the seam between them, and one is whole below its neck.
    cut = np.where(near[seam].mean(0) < ALONG, np.inf, near[~seam].sum(0) / seam.sum())
    side = off[:, cut.argmin()] > 0
    small = min(side.sum(), (~side).sum()) < max(PART * len(cells), LEAST_PART)
    return whole if cut.min() > SHARED or small else side.astype(int)


def _nearest(
    cells: Float[np.ndarray, "o 3"], part: Int[np.ndarray, " o"], kept: Int[np.ndarray, " k"]
) -> Int[np.ndarray, " o"]:
    """The same with the kept parts alone, numbered from 0, to which all other cubes go that are nearest to them."""
    if len(kept) < 2:
        return np.zeros(len(cells), int)
    own = np.flatnonzero(np.isin(part, kept))
    return np.searchsorted(kept, part[own[np.asarray(KDTree(cells[own]).query(cells)[1])]])


def _beside(cells: Float[np.ndarray, "o 3"], sides: Int[np.ndarray, " o"]) -> Int[np.ndarray, " o"]:
    """The same with those parts joined of which one lies within the other's hull."""
    parts = [cells[sides == k] for k in range(int(sides.max()) + 1)]
    pairs = [(i, k) for i, one in enumerate(parts) for k, other in enumerate(parts) if i != k and _within(one, other) > WITHIN]
    return joined(np.array(pairs, int).reshape(-1, 2), len(parts))[sides]


def _within(points: Float[np.ndarray, "k d"], others: Float[np.ndarray, "m d"]) -> float:
    """Share of points that are inside the convex hull of others."""
    try:
        hull = ConvexHull(others).equations
    except QhullError:  # flat
        return 0.0
    return float(((points @ hull[:, :-1].T + hull[:, -1]).max(1) < -INSIDE).mean())


def _standing(
    surface: Surface, own: Int[np.ndarray, " o"], sides: Int[np.ndarray, " o"], levels: list[Float[np.ndarray, "4"]]
) -> Int[np.ndarray, " o"]:
    """The same with those parts alone that reach down to a plane, or may do so out of sight."""
    cells = surface.cells[own]
    kept = [k for k in range(int(sides.max()) + 1) if _reaches_down(surface, cells[sides == k], cells[sides != k], levels)]
    return _nearest(cells, sides, np.array(kept, int))


def _reaches_down(
    surface: Surface, part: Float[np.ndarray, "k 3"], others: Float[np.ndarray, "m 3"], levels: list[Float[np.ndarray, "4"]]
) -> bool:
    feet = [float(np.quantile(part @ plane[:3] - plane[3], 0.05)) for plane in levels]
    above = [k for k, foot in enumerate(feet) if foot > -FOOT]
    if not above or not len(others):
        return False
    lowest = min(above, key=lambda k: abs(feet[k]))
    if feet[lowest] < FOOT:
        return True
    plane = levels[lowest]
    along = np.linalg.svd(plane[None, :3])[2][1:]
    if _within(part @ along.T, others @ along.T) > 0.5:
        return False  # it stands on another part
    height = part @ plane[:3] - plane[3]
    bottom = _bottom(part @ along.T, height)
    free = np.zeros(int(bottom.sum()), bool)
    for share in BELOW:
        free |= _seen_free(surface, part[bottom] - share * height[bottom, None] * plane[:3])
    return float(free.mean()) < FREE


def _bottom(along: Float[np.ndarray, "k 2"], height: Float[np.ndarray, " k"]) -> Bool[np.ndarray, " k"]:
    """The lowest of the cubes that are above one another."""
    i, j = KDTree(along).query_pairs(ASIDE, output_type="ndarray").T
    low = height.copy()
    np.minimum.at(low, i, height[j])
    np.minimum.at(low, j, height[i])
    return height <= low + ASIDE / 2


def _seen_free(surface: Surface, places: Float[np.ndarray, "k 3"]) -> Bool[np.ndarray, " k"]:
    """Whether the camera saw past each place, so that nothing is there."""
    (rays, far), ways = surface.rays, places - surface.camera
    away = np.linalg.norm(ways, axis=1)
    apart, nearest = rays.query(ways / away[:, None])
    return np.asarray((apart * away > 1.5 * surface.edge) | (far[nearest] > away + BEHIND))
