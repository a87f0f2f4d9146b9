"""A view of a scene taken apart: large planes (tables, boards, walls), the things that stand apart, and the rest."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import ConvexHull, KDTree

from dro_grasp.geometry.point_groups import local_normals
from dro_grasp.geometry.table_plane import MOST_THICK, WINDOW, largest_plane, scatter, thickness
from dro_grasp.objects.perception.seams import Surface, joined, parted

CELL = 0.004  # Edge of the cubes whose points are averaged [m] (ours): noise of single pixels goes, a finger's width stays
NOISES = 2.0  # Standard deviations of the noise that a cube measures at least [1] (ours)
TAILS = 3.5  # Standard deviations of the noise beyond which points are too few to hang together [1] (ours)
REFITS = 2  # Fits to the points of a plane that is noisy (ours)
MOST_EDGE = 0.008  # Largest edge for their sake [m] (ours)
MOST_CELLS = 45_000  # Filled cubes above which they grow (ours): what two cores take apart in 2 s
REACH = 1.5  # Points nearer to the camera than this count [m], and those up to twice the distance of the nearest (ours)
NEIGHBOURS = 24  # Neighbours that estimate a normal (ours): about 12 mm around
NEAR = 0.008  # Points at most this far from a plane are counted for it [m] (ours)
TILTED = 0.7  # Least cosine between a plane's normal and those of its points [1] (ours)
MOST_PLANES = 12  # Planes that are tried (ours): a shelf has eight
PATCH = 0.02  # Edge of the squares in which a plane's area is counted [m] (ours)
LEAST_AREA = 0.01  # Area from which a plane may be a wall [m^2] (ours)
FIRST_AREA = 0.04  # Area from which the largest plane is what things stand on [m^2] (ours)
CERTAIN_AREA = 0.1  # Area from which a plane is no side of a thing that a hand grasps [m^2] (ours)
SPANS = 0.5  # Share of the largest plane's length that a smaller one beside it spans if it is a wall [1] (ours)
LEAST_WALL = 0.25  # Shortest diagonal of a wall [m] (ours)
LEAST_BOARD = 0.4  # Shortest diagonal of a board along the largest plane [m] (ours)
LEAST_BOARD_AREA = 0.03  # Least area of a board along the largest plane [m^2] (ours)
FILLED = 0.65  # Share of its convex hull that such a board fills [1] (ours): the level tops of several things do not
WALL_THICK = 0.016  # Half thickness of such a wall [m] (ours)
LONGEST_FACE = 0.35  # Longest thing that is all one plane: what is longer is a wall seen from outside [m] (ours)
FLOATS = 0.04  # Height above all planes from which a thing floats, so that it is a part of one below it [m] (ours)
GAP = 0.06  # Largest gap between these [m] (ours)
LONGEST_JOINED = 0.35  # Longest thing that both may be [m] (ours): what floats is a lamp or an arm else
UNDER = 0.01  # Distance aside up to which one is below the other [m] (ours)
BACK = 0.03  # Points so far behind a plane are the edges of its board [m] (ours)
LINK = 2.5  # Longest distance of neighbours of one thing, in cubes [1] (ours)
CORE = 5  # Neighbours of a cube that joins others (ours): single points between two things, as cameras make, join none
LEAST_THING = 24  # Filled cubes of a thing, at least (ours): 4 square centimetres, 15 under strong noise
LEAST_SPECK = 5  # Filled cubes of what hands avoid, at least (ours)
LONGEST_THING = 0.6  # Longest thing that a hand may be meant to grasp [m] (ours)
FRAGMENT = 0.015  # Scattered points nearer to a thing than this may be parts of it [m] (ours)
NOTHING = -1  # Label of scattered points; things have numbers from 0
STRUCTURE = -2  # Label of tables, boards and walls
OTHER = -3  # Label of what is too large or too far away to be meant
SPECK = -4  # Label of what is too small


@dataclass(frozen=True, eq=False)
class Segments:
    """What a view shows."""

    labels: Int[np.ndarray, " n"]
    """Of each point: the number of its thing, the one with most points first, or NOTHING, STRUCTURE, OTHER or SPECK."""
    planes: tuple[Float[np.ndarray, "4"], ...]
    """Planes: unit normals to the side from which they were seen, and heights along them [m]."""
    areas: tuple[float, ...]
    """Their visible areas [m^2]."""
    seams: tuple[bool, ...]
    """For each thing, whether a seam runs over it, as between two things that touch."""
    parts: Int[np.ndarray, " n"]
    """Of each point: which of the things that touch it may be, of those that its thing may consist of; 0 where it is one."""

    @property
    def count(self) -> int:
        """How many things there are."""
        return len(self.seams)


def segment(
    points: Float[np.ndarray, "n 3"], camera: Float[np.ndarray, "3"] | None = None, up: Float[np.ndarray, "3"] | None = None
) -> Segments:
    """Take a cloud apart, which the camera sees from its place [m]; without one, it was seen from all sides.

    Things stand on planes that are level, as far as the way up is known and such are seen, else on those along the largest.
    Large planes come first, by sampled fits. What is left is joined by distance between points that have enough neighbours,
    as in DBSCAN. Source: Fischler and Bolles 1981; Ester et al. 1996.
    """
    view = _View.of(points, camera)
    edge, noise = _edge(view, points)
    view = replace(_View.of(points, camera, edge) if edge > view.edge else view, noise=noise)
    planes = _planes(view)
    owned = np.full(len(view.cells), NOTHING)
    for plane in planes:
        owned[plane.owns(view)] = STRUCTURE
    rest = np.flatnonzero(owned == NOTHING)
    parts = np.zeros(len(view.cells), int)
    owned[rest], parts[rest], seams = _things(view, rest, _levels([plane.plane for plane in planes], up))
    seen = view.cell_of >= 0
    return Segments(np.where(seen, owned[view.cell_of], OTHER), tuple(p.plane for p in planes), tuple(p.area for p in planes),
                    seams, np.where(seen, parts[view.cell_of], 0))


@dataclass(frozen=True, eq=False)
class _View:
    """The cubes of a cloud."""

    cells: Float[np.ndarray, "k 3"]  # mean of the points of each [m]
    normals: Float[np.ndarray, "k 3"]  # unit normals, to the camera or to no side
    edge: float  # of the cubes [m]
    camera: Float[np.ndarray, "3"] | None
    cell_of: Int[np.ndarray, " n"]  # cube of each point; -1 for points too far away
    points: Float[np.ndarray, "n 3"]  # [m]
    noise: float = 0.0  # standard deviation of the points of the largest plane around those beside them [m]

    @classmethod
    def of(
        cls, points: Float[np.ndarray, "n 3"], camera: Float[np.ndarray, "3"] | None, edge: float = CELL
    ) -> _View:
        kept: Bool[np.ndarray, " n"] = np.ones(len(points), bool)
        cell_of = np.full(len(points), -1)
        if camera is not None and len(points):
            away = np.linalg.norm(points - camera, axis=1)
            kept = away < max(REACH, 2 * float(np.quantile(away, 0.02)))
        cells, own, edge = _averaged(points[kept], edge)
        cell_of[kept] = own
        normals = local_normals(cells, NEIGHBOURS)
        if camera is not None:
            normals = normals * np.where(((camera - cells) * normals).sum(1, keepdims=True) < 0, -1.0, 1.0)
        return cls(cells, normals, edge, camera, cell_of, points)


def _edge(view: _View, points: Float[np.ndarray, "n 3"]) -> tuple[float, float]:
    """Edge of cubes in which noise averages out, as the points near the largest plane scatter, and their noise alone [m].

    Apart from noise, they scatter where a plane is bent, or two are nearly one.
    """
    fit = largest_plane(view.cells, NEAR, fits=3)
    if fit is None:
        return CELL, 0.0
    height = points @ fit[:3] - fit[3]
    facing = (np.abs(view.normals @ fit[:3]) > TILTED)[view.cell_of] & (view.cell_of >= 0)
    near = np.flatnonzero(facing & (np.abs(height) < WINDOW))
    at = np.floor(points[near] @ np.linalg.svd(fit[None, :3])[2][1:].T / PATCH).astype(int)
    at -= at.min(0, initial=0)
    square = at[:, 0] * (at[:, 1].max(initial=0) + 1) + at[:, 1]
    middle = np.bincount(square, height[near]) / np.maximum(np.bincount(square), 1)
    return min(NOISES * scatter(height[facing]), MOST_EDGE), scatter(height[near] - middle[square])


def _averaged(points: Float[np.ndarray, "n 3"], edge: float) -> tuple[Float[np.ndarray, "k 3"], Int[np.ndarray, " n"], float]:
    """Means of the points in each filled cube [m], the cube of each point, and the cubes' edge [m]."""
    low = points.min(0)
    while True:
        index = np.floor((points - low) / edge).astype(np.int64)
        sides = index.max(0) + 1
        _, own = np.unique((index[:, 0] * sides[1] + index[:, 1]) * sides[2] + index[:, 2], return_inverse=True)
        own = own.reshape(-1)
        count = int(own.max()) + 1
        if count <= MOST_CELLS:
            break
        edge *= max(1.1, (count / MOST_CELLS) ** 0.5)
    number = np.bincount(own, minlength=count)
    return np.stack([np.bincount(own, points[:, k], count) / number for k in range(3)], 1), own, edge


@dataclass(frozen=True, eq=False)
class _Plane:
    """A plane with the patch of it that was seen."""

    plane: Float[np.ndarray, "4"]  # unit normal to the side that was seen, and height along it [m]
    thick: float  # [m]
    axes: Float[np.ndarray, "2 3"]  # along the plane
    corner: Float[np.ndarray, "2"]  # of the patch [m]
    patch: Bool[np.ndarray, "u v"]  # squares of PATCH that are its own
    area: float  # [m^2]
    own: Int[np.ndarray, " _"]  # cubes that are on it

    def height(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        return points @ self.plane[:3] - self.plane[3]

    @property
    def filled(self) -> float:
        """Share of the patch's convex hull that the patch fills."""
        squares = np.argwhere(self.patch)
        corners = np.concatenate([squares + corner for corner in ((0, 0), (0, 1), (1, 0), (1, 1))])
        return len(squares) / float(ConvexHull(corners).volume)

    def beside(self, points: Float[np.ndarray, "n 3"], grown: int) -> Bool[np.ndarray, " n"]:
        """Points over or under the patch, grown by some squares."""
        patch = np.pad(self.patch, grown + 3)
        patch = ndimage.binary_closing(patch, iterations=3)
        if grown:
            patch = ndimage.binary_dilation(patch, iterations=grown)
        at = np.floor((points @ self.axes.T - self.corner) / PATCH).astype(int) + grown + 3
        inside: Bool[np.ndarray, " n"] = np.asarray(((at >= 0) & (at < patch.shape)).all(1))
        inside[inside] = patch[tuple(at[inside].T)]
        return inside

    def owns(self, view: _View) -> Bool[np.ndarray, " k"]:
        """Which cubes are the plane's, or those of the board behind it."""
        height = self.height(view.cells)
        on = np.abs(height) <= self.thick
        # The foot of a thing that stands on it has other normals than the plane.
        on &= (np.abs(view.normals @ self.plane[:3]) > TILTED / 2) | (height < self.thick / 2)
        back = (height < 0) & (height > -BACK)
        close = np.flatnonzero(on | back)
        mine = np.zeros(len(height), bool)
        mine[close] = self.beside(view.cells[close], 1)
        return mine


def _planes(view: _View) -> list[_Plane]:
    """The planes that are no sides of things."""
    pool, found = np.arange(len(view.cells)), []
    for _ in range(MOST_PLANES):
        fit = largest_plane(view.cells[pool], NEAR, fits=3)
        if fit is None:
            break
        plane = _seen_plane(view, pool, fit)
        if view.edge > CELL:  # cubes come in layers then, of which the fit took one
            for _ in range(REFITS):
                plane = _seen_plane(view, pool, _fit_of_points(view, plane))
        if plane.area < LEAST_AREA:
            break
        if _is_structure(view, plane, found):
            found.append(plane)
            pool = pool[~plane.owns(view)[pool]]
        pool = np.setdiff1d(pool, plane.own, assume_unique=True)
    return found


def _seen_plane(view: _View, pool: Int[np.ndarray, " p"], fit: Float[np.ndarray, "4"]) -> _Plane:
    height = view.cells[pool] @ fit[:3] - fit[3]
    facing = np.abs(view.normals[pool] @ fit[:3]) > TILTED
    # Cubes average noise away, but for those at its tails: they hold a few points each, and would be a crust of the plane.
    thick = max(thickness(height[facing]), min(TAILS * view.noise, MOST_THICK))
    own = pool[(np.abs(height) <= thick) & facing]
    axes = np.linalg.svd(fit[None, :3])[2][1:]
    along = view.cells[own] @ axes.T
    corner = along.min(0) if len(own) else np.zeros(2)
    at = np.floor((along - corner) / PATCH).astype(int)
    patch = np.zeros(at.max(0, initial=0) + 1, bool)
    patch[tuple(at.T)] = True
    # Planes through the sides of several things are made of patches that stand apart: the largest counts, and of a table, which
    # shadows part, others as well.
    pieces, count = ndimage.label(ndimage.binary_closing(np.pad(patch, 2), iterations=2), np.ones((3, 3)))  # type: ignore
    pieces = pieces[2:-2, 2:-2]
    sizes = np.bincount(pieces[patch], minlength=count + 1)
    certain = sizes.max() * PATCH**2 >= CERTAIN_AREA
    large = np.flatnonzero(sizes >= (0.1 if certain else 1.0) * max(1, sizes.max()))
    patch &= np.isin(pieces, large)
    own = own[patch[tuple(at.T)]]
    side = view.camera @ fit[:3] - fit[3] if view.camera is not None else float(
        (height > thick).sum() - (height < -thick).sum())
    return _Plane(fit if side >= 0 else -fit, thick, axes, corner, patch, float(sizes.max()) * PATCH**2, own)


def _fit_of_points(view: _View, plane: _Plane) -> Float[np.ndarray, "4"]:
    """The plane through the points in its cubes, and in those over and under them: unit normal, and height along it [m]."""
    near = np.flatnonzero(np.abs(plane.height(view.cells)) <= plane.thick + view.edge)
    own = np.zeros(len(view.cells), bool)
    own[near] = plane.beside(view.cells[near], 0)
    own[near] &= np.abs(view.normals[near] @ plane.plane[:3]) > TILTED
    points = view.points[(view.cell_of >= 0) & own[view.cell_of]]
    if len(points) < 3:
        return plane.plane
    points = points[np.abs(plane.height(points)) <= 2 * plane.thick]
    middle = points.mean(0)
    normal = np.linalg.eigh((points - middle).T @ (points - middle))[1][:, 0]
    return np.append(normal, normal @ middle) * math.copysign(1.0, float(normal @ plane.plane[:3]))


def _is_structure(view: _View, plane: _Plane, found: list[_Plane]) -> bool:
    """Whether a plane is a table, a board or a wall, and no side of a thing."""
    if plane.area >= CERTAIN_AREA or (not found and plane.area >= FIRST_AREA):
        return True
    if not found:
        return False
    # A wall or a board meets the largest plane at a right angle, or lies along it, and is about as long.
    base = found[0]
    cosine = abs(float(plane.plane[:3] @ base.plane[:3]))
    if not (cosine < 0.2 or cosine > 0.97):
        return False
    points, ground = view.cells[plane.own], view.cells[base.own]
    longest = float(np.hypot(*np.ptp(np.quantile(points @ plane.axes.T, [0.02, 0.98], axis=0), axis=0)))
    if longest < (LEAST_WALL if cosine < 0.2 else LEAST_BOARD):
        return False
    if cosine > 0.97:
        return plane.area >= LEAST_BOARD_AREA and plane.filled >= FILLED
    along = np.cross(plane.plane[:3], base.plane[:3])
    along = along / np.linalg.norm(along)
    low, high = np.quantile(points @ along, [0.02, 0.98])
    if high - low < SPANS * float(np.ptp(np.quantile(ground @ along, [0.02, 0.98]))):
        return False
    # The face of a box has more of the table behind it, a wall has none.
    within = ground[(ground @ along > low) & (ground @ along < high)]
    return float((plane.height(within) < -BACK).mean()) < 0.1 if len(within) else True


def _levels(planes: list[Float[np.ndarray, "4"]], up: Float[np.ndarray, "3"] | None) -> list[Float[np.ndarray, "4"]]:
    """The planes on which things stand, largest first."""
    level = [plane for plane in planes if up is not None and plane[:3] @ up > 0.9]
    return level or [plane for plane in planes if plane[:3] @ planes[0][:3] > 0.9]


def _things(
    view: _View, rest: Int[np.ndarray, " r"], levels: list[Float[np.ndarray, "4"]]
) -> tuple[Int[np.ndarray, " r"], Int[np.ndarray, " r"], tuple[bool, ...]]:
    """The label and the part of each cube that is left, and whether a seam runs over each thing."""
    cells = view.cells[rest]
    labels, parts = np.full(len(rest), NOTHING), np.zeros(len(rest), int)
    if not len(rest):
        return labels, parts, ()
    pairs = KDTree(cells).query_pairs(max(0.01, LINK * view.edge), output_type="ndarray")
    core = np.bincount(pairs.ravel(), minlength=len(rest)) >= CORE
    group = joined(pairs[core[pairs].all(1)], len(rest))
    _join_floating(cells, group, levels)
    sizes = np.bincount(group)
    large = [int(g) for g in np.argsort(-sizes, kind="stable") if sizes[g] >= LEAST_THING]
    surface = None if view.camera is None else Surface(cells, view.normals[rest], view.camera, view.edge, pairs)
    seams: list[bool] = []
    for g in large:
        own = np.flatnonzero(group == g)
        if _is_other(cells[own], levels):
            labels[own] = OTHER
            continue
        labels[own] = len(seams)
        parts[own], seam = parted(surface, own, levels) if surface else (0, False)
        seams.append(seam)
    _take_fragments(cells, labels, parts)
    labels[(labels == NOTHING) & (sizes[group] >= LEAST_SPECK)] = SPECK
    return labels, parts, tuple(seams)


def _is_other(cells: Float[np.ndarray, "k 3"], levels: list[Float[np.ndarray, "4"]]) -> bool:
    """Whether something is no thing to grasp: too long, a wall, or below all that things stand on."""
    longest = float(np.ptp(cells, axis=0).max())
    if longest > LONGEST_THING or (levels and max(float(np.median(_over(cells, plane))) for plane in levels) < 0):
        return True
    over = [low for plane in levels if (low := float(np.quantile(_over(cells, plane), 0.02))) > 0]
    if longest <= (LEAST_WALL if over and min(over) > FLOATS else LONGEST_FACE):
        return False
    fit = largest_plane(cells, NEAR)
    return fit is not None and float((np.abs(_over(cells, fit)) < WALL_THICK).mean()) > 0.85


def _over(points: Float[np.ndarray, "n 3"], plane: Float[np.ndarray, "4"]) -> Float[np.ndarray, " n"]:
    return points @ plane[:3] - plane[3]


def _join_floating(
    cells: Float[np.ndarray, "r 3"], group: Int[np.ndarray, " r"], levels: list[Float[np.ndarray, "4"]]
) -> None:
    """Join what floats to what is below it, in place: a thing may hide its own middle."""
    if not levels:
        return
    sizes = np.bincount(group)
    flat = np.linalg.svd(levels[0][None, :3])[2][1:]
    for g in np.flatnonzero(sizes >= LEAST_THING):
        own = cells[group == g]
        lows = [low for plane in levels if (low := float(np.quantile(_over(own, plane), 0.02))) > 0]
        if not lows or min(lows) < FLOATS:
            continue
        others = np.flatnonzero((group != g) & (sizes[group] >= LEAST_THING))
        below = others[_over(cells[others], levels[0]) < float(np.quantile(_over(own, levels[0]), 0.02))]
        if not len(below):
            continue
        beside = KDTree(own @ flat.T).query(cells[below] @ flat.T)[0] < UNDER
        gap = KDTree(own).query(cells[below])[0]
        near = below[beside & (gap < GAP)]
        if not len(near):
            continue
        under = group[near[gap[beside & (gap < GAP)].argmin()]]
        if np.ptp(cells[(group == g) | (group == under)], axis=0).max() <= LONGEST_JOINED:
            group[group == g] = under


def _take_fragments(
    cells: Float[np.ndarray, "r 3"], labels: Int[np.ndarray, " r"], parts: Int[np.ndarray, " r"]
) -> None:
    """Give scattered cubes to the thing beside them, and to its part, in place."""
    things, scattered = np.flatnonzero(labels >= 0), np.flatnonzero(labels == NOTHING)
    if len(things) and len(scattered):
        away, nearest = KDTree(cells[things]).query(cells[scattered])
        near = np.flatnonzero(away < FRAGMENT)
        beside = things[np.asarray(nearest)[near]]
        labels[scattered[near]], parts[scattered[near]] = labels[beside], parts[beside]
