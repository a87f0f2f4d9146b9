"""Flat things on a table, as a camera sees them: an outline in the image, and hardly any height in its depth.

A card is thinner than the noise of a camera that is a metre away. Where its pixels are known, from colours or a segmentation,
each of them is a ray, which meets the known plane in one point: that gives the outline, and depth only tells how high it is.
Ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_closing, distance_transform_edt
from scipy.spatial import ConvexHull, KDTree

from dro_grasp.arm.robots.robot import Table
from dro_grasp.errors import ObjectError
from dro_grasp.geometry.table_plane import largest_plane
from dro_grasp.objects.loading import MIN_CLOUD, cloud_object, mesh_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.objects.solids import as_part, hull, trimesh

FEWEST = 30  # Fewest points of a flat thing (ours)
LOW = 0.035  # Height up to which a thing counts as flat [m] (ours), as `predict.constraints.LOW`
THINNEST = 0.001  # Height that a thing has at least [m] (ours): a card has 0.8 mm
TOP = 0.85  # Share of the points of a part that its top is above [1] (ours)
BESIDE = 0.008  # A point with fewer than NEIGHBOURS others within this distance is noise [m] (ours)
SPACINGS = 2.0  # The same in usual distances to as many neighbours [1] (ours): pixels at a glancing angle are far apart
NEIGHBOURS = 3  # Fewest others there of a point that is none (ours)
SAME = 0.003  # Points at most this far from the plane are the table's [m] (ours)
ABOVE = 0.006  # Height from which on what is seen counts as another thing [m] (ours)
HIGHEST = 0.4  # Height up to which it does [m] (ours)
ASIDE = 0.01  # Distance from the thing from which on it does [m] (ours)
STRIP = 0.015  # Length of the parts that a thing is cut into, where its outline is not convex [m] (ours)
MOST_STRIPS = 16  # Most of them (ours)
FINEST = 0.004  # Edge of the cells of an outline, at least [m] (ours)
FILLED = 0.9  # Share of its hull that strips fill, from which on a thing counts as convex [1] (ours)


def height_of(points: Float[np.ndarray, "n 3"], table: float) -> float:
    """How high a thing is above a table at a height [m], by its points in the world; noise counts little."""
    return float(np.quantile(points[:, 2], 0.9)) - table


def width_of(points: Float[np.ndarray, "n 3"]) -> float:
    """Diameter of the largest circle within the outline of points, as seen from above [m]: of a hammer, about its handle's."""
    flat = points[:, :2] - points[:, :2].min(0)
    cell = max(FINEST, 2 * float(np.median(KDTree(flat).query(flat, 2)[0][:, 1])))
    places = (flat / cell).astype(int) + 2
    seen = np.zeros(places.max(0) + 3, bool)
    seen[tuple(places.T)] = True
    inside = np.asarray(distance_transform_edt(binary_closing(seen, np.ones((3, 3)))))
    return float(2 * cell * inside.max() - cell)


def lies_flat(points: Float[np.ndarray, "n 3"], table: float) -> bool:
    """Whether a thing ends so low above the table that it counts as flat."""
    return height_of(points, table) < LOW


def overhang(points: Float[np.ndarray, "n 3"], table: Table) -> Float[np.ndarray, " n"]:
    """How far points are outside the table, seen from above [m]; negative within it."""
    return (np.abs(points[:, :2] - table.centre) - np.array(table.size) / 2).max(1)


@dataclass(frozen=True, eq=False)
class SeenFlat:
    """A flat thing on a table, as it was seen."""

    obj: ObjectModel  # In the world
    others: list[ObjectModel]  # Other things on the table, as one cloud in the world, if there are any
    table: float  # Height of the table [m]


def seen_flat(
    name: str, points: Float[np.ndarray, "n 3"], mask: Bool[np.ndarray, " n"], table: Table, eye: Float[np.ndarray, "3"]
) -> SeenFlat | None:
    """A thing of which the pixels are known, if it lies flat; None for other things, and where no table is seen.

    Args:
        name: What to call it.
        points: All that was seen, in the world [m]: the table, too.
        mask: Which points are of the thing; where it overhangs its table, too.
        table: Where the table is, but for its exact height.
        eye: Where the camera is [m].
    """
    inside = overhang(points, table) < 0
    plane = largest_plane(points[inside & ~mask], SAME, 0.2, fits=3)
    if plane is None:
        return None
    height = float((plane[3] - plane[:2] @ np.array(table.centre)) / plane[2])
    if mask.sum() < FEWEST or not lies_flat(points[mask], height):
        return None
    standing = points[inside & ~mask & (points[:, 2] > height + ABOVE) & (points[:, 2] < height + HIGHEST)]
    apart = standing[KDTree(points[mask]).query(standing)[0] > ASIDE] if len(standing) else standing
    others = [cloud_object("other things", apart, origin="other things", keep_table=True)] if len(apart) >= MIN_CLOUD else []
    return SeenFlat(flat_object(name, points[mask], eye, height), others, height)


def flat_object(
    name: str, points: Float[np.ndarray, "n 3"], eye: Float[np.ndarray, "3"], table: float
) -> ObjectModel:
    """A flat thing as a solid in the world's frame: prisms from the table to its tops.

    Args:
        name: What to call it.
        points: Points of the thing alone, in the world [m].
        eye: Where the camera is that saw them [m].
        table: Height of the table [m].

    Raises:
        ObjectError: There are too few points.
    """
    if len(points) < FEWEST:
        raise ObjectError(f"'{name}' has {len(points)} points, and at least {FEWEST} are needed; give a mask that is true on "
                          "all of it, or bring the camera nearer")
    top = table + max(THINNEST, float(np.median(points[:, 2])) - table)
    share = (eye[2] - top) / (eye[2] - points[:, 2])
    outline = (eye + share[:, None] * (points - eye))[:, :2]
    spacing = KDTree(outline).query(outline, NEIGHBOURS + 1)[0][:, -1]
    kept = spacing < max(BESIDE, SPACINGS * float(np.median(spacing)))
    if kept.sum() < FEWEST:
        kept[:] = True
    outline, height = outline[kept], points[kept, 2] - table
    pieces = [_prism(outline[rows], height[rows], table) for rows in _strips(outline)]
    if not all(piece.is_volume for piece in pieces):  # slivers
        pieces = [_prism(outline, height, table)]
    corners, sides, first = [], [], 0
    for piece in pieces:
        corners.append(piece.vertices)
        sides.append(piece.faces + first)
        first += len(piece.vertices)
    whole = trimesh.Trimesh(np.concatenate(corners), np.concatenate(sides), process=False)
    if len(pieces) > 1:
        whole = trimesh.boolean.union(pieces, engine="manifold")
    return mesh_object(name, whole, origin=name, parts=tuple(as_part(piece) for piece in pieces))


def _strips(outline: Float[np.ndarray, "n 2"]) -> list[Bool[np.ndarray, " n"]]:
    """Which points are of each part of a thing: one, or strips across its longest extent, which share their borders."""
    middle = outline - outline.mean(0)
    along = middle @ np.linalg.svd(middle, full_matrices=False)[2][0]
    count = int(np.clip(np.ptp(along) / STRIP, 1, MOST_STRIPS))
    borders = np.linspace(along.min(), along.max(), count + 1)
    overlap = 0.3 * (borders[1] - borders[0])
    strips = [(along > a - overlap) & (along < b + overlap) for a, b in pairwise(borders)]
    strips = [rows for rows in strips if rows.sum() >= 4 and np.linalg.svd(
        outline[rows] - outline[rows].mean(0), compute_uv=False)[1] > 1e-3]
    whole = ConvexHull(outline).volume
    filled = sum(ConvexHull(outline[rows]).volume for rows in strips) / (1 + 2 * 0.3) if strips else whole
    return strips if strips and filled < FILLED * whole else [np.ones(len(outline), bool)]


def _prism(outline: Float[np.ndarray, "n 2"], height: Float[np.ndarray, " n"], table: float) -> trimesh.Trimesh:
    """From the table up to what most of the points are below."""
    corners = outline[ConvexHull(outline).vertices]
    top = max(THINNEST, float(np.quantile(height, TOP)) if np.median(height) > 0.005 else float(np.median(height)))
    levels = [np.column_stack([corners, np.full(len(corners), z)]) for z in (table, table + top)]
    return hull(np.concatenate(levels))
