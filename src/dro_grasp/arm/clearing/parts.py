"""Things that touch are seen as one: where it is narrow between two thick parts, each part may be picked for itself. Ours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import maximum, uniform_filter1d
from scipy.spatial import KDTree

from dro_grasp.arm.tabletop.table_scene import PickedObject
from dro_grasp.objects.loading import MIN_CLOUD, cloud_object

CELL = 0.005  # Edge of the columns that a thing is taken for [m] (ours)
DIRECTIONS = 16  # Directions of vertical cuts that are tried (ours)
SMALLEST = 0.15  # Least share of the volume that is a part (ours)
NARROW = 0.7  # Largest cross-section of a cut, as a share of the largest one beyond it on either side (ours)
TOUCH = 0.015  # What is nearer to a part is not in its way [m] (ours): it has to come off from there


def parted(picked: PickedObject) -> list[PickedObject]:
    """The two parts of what was picked as one, the higher first, each with the other in its way; or none."""
    cloud = picked.obj.cloud
    assert picked.robot.table is not None
    side = narrowest(cloud, picked.robot.table.height)
    if side is None or min(side.sum(), (~side).sum()) < MIN_CLOUD:
        return []
    sides = sorted((side, ~side), key=lambda own: -float(cloud[own, 2].max()))
    return [_part(picked, own) for own in sides]


def narrowest(points: Float[np.ndarray, "n 3"], height: float) -> Bool[np.ndarray, " n"] | None:
    """Which points on a table of this height [m] are on one side of the narrowest vertical cut; None if none is narrow."""
    cells, column = np.unique(np.floor(points[:, :2] / CELL).astype(int), axis=0, return_inverse=True)
    tops = np.asarray(maximum(points[:, 2], column.ravel(), np.arange(len(cells)))) - height
    middles, best, found = (cells + 0.5) * CELL, NARROW, None
    for angle in np.pi * np.arange(DIRECTIONS) / DIRECTIONS:
        across = np.array([np.cos(angle), np.sin(angle)])
        place = np.floor(middles @ across / CELL).astype(int)
        section = uniform_filter1d(np.bincount(place - place.min(), np.maximum(tops, 0.0)), 3, mode="constant")
        volume = section.cumsum() / section.sum()
        left, right = np.maximum.accumulate(section), np.maximum.accumulate(section[::-1])[::-1]
        share = section / np.maximum(np.minimum(left, right), 1e-12)
        share[(volume < SMALLEST) | (volume > 1 - SMALLEST)] = np.inf
        if share.min() < best:
            best, cut = float(share.min()), int(share.argmin())
            found = points[:, :2] @ across < (cut + place.min() + 0.5) * CELL
    return found


def _part(picked: PickedObject, own: Bool[np.ndarray, " n"]) -> PickedObject:
    """Some of its points as an object, and others as one more thing that is in the way."""
    obj, seen = picked.obj, picked.obj.seen
    rows = np.concatenate([obj.cloud, obj.cloud_normals], 1)
    if seen is not None:
        seen = seen[own[KDTree(obj.cloud).query(seen)[1]]]
    part = cloud_object(obj.name, rows[own], origin=obj.name, keep_table=True, seen=seen)
    rest = obj.cloud[~own]
    rest = rest[KDTree(obj.cloud[own]).query(rest)[0] > TOUCH]
    beside = [cloud_object("what touches it", rest, origin=obj.name, keep_table=True)] if len(rest) >= MIN_CLOUD else []
    return replace(picked, obj=part, obstacles=[*picked.obstacles, *beside])
