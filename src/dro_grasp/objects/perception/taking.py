"""One object out of a scene: its unseen side completed, without what would be in the table or in other things."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from dro_grasp.errors import ObjectError
from dro_grasp.geometry.table_plane import moved_plane
from dro_grasp.objects.loading import MIN_CLOUD, cloud_object
from dro_grasp.objects.perception.choosing import Chosen, Sight, place_of
from dro_grasp.objects.perception.scan import scanned_object
from dro_grasp.objects.perception.segmentation import Segments
from dro_grasp.objects.shape import ObjectModel

CLEAR = 0.006  # Completed points nearer to what was seen of other things are left out [m] (ours)
ON_OTHERS = 0.01  # What is this near to other things may lie on them, and not on the plane [m] (ours)
RESTS = 0.002  # What ends no higher above the plane stands on it [m] (ours)
HOLLOW = 0.35  # What ends higher than this share of its height above it is not known well enough to be made longer (ours)


def taken_object(name: str, sight: Sight, segments: Segments, chosen: Chosen) -> ObjectModel:
    """The object of the chosen points in the scene's frame, with the plane below it as its table."""
    points = sight.points[chosen.own]
    below = None if chosen.below is None else segments.planes[chosen.below]
    table = None if below is None else moved_plane(below, sight.T)
    if not sight.from_camera:
        obj = cloud_object(name, points, origin=name, keep_table=True)
        return replace(obj, table=table, notes=(*obj.notes, *chosen.notes))
    whole = scanned_object(name, points, sight.T, keep_table=True, table=below)
    cloud, kept = whole.cloud.astype(np.float64), np.ones(len(whole.cloud), bool)
    if table is not None:
        kept &= cloud @ table[:3] > table[3]
    if len(chosen.others):
        kept &= KDTree(sight.world()[chosen.others]).query(cloud)[0] > CLEAR
    if kept.sum() < MIN_CLOUD:
        place = place_of(sight.world()[chosen.own])
        raise ObjectError(f"of the thing at {place} in '{name}', {int(kept.sum())} of {len(kept)} points are above the plane "
                          "below it and apart from other things; look at a picture of the scene (draw_scene), and mean another "
                          "thing, or give its pixels (mask=PNG)")
    cloud, normals = cloud[kept], whole.cloud_normals[kept].astype(np.float64)
    alone = not len(chosen.others) or KDTree(sight.world()[chosen.others]).query(cloud)[0].min() > ON_OTHERS
    if table is not None and whole.seen is not None and alone:
        cloud, normals = set_down(cloud, normals, KDTree(whole.seen).query(cloud)[0] > 0.0, table)
    rows = np.concatenate([cloud, normals], 1)
    obj = cloud_object(name, rows, origin=name, keep_table=True, seen=whole.seen)
    return replace(obj, table=table, notes=(*whole.notes, *chosen.notes))


def set_down(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], added: Bool[np.ndarray, " n"],
    table: Float[np.ndarray, "4"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Points [m] and unit normals with an underside that reaches the plane below: what rests on a plane touches it.

    From above, the underside of a lying thing is not seen, and is completed too high. The added points of the lower half are
    moved down, in proportion to their depth; what was seen stays where it is.
    """
    up = table[:3] / np.linalg.norm(table[:3])
    height = (points @ table[:3] - table[3]) / np.linalg.norm(table[:3])
    gap, middle = float(height.min()), float(height.max()) / 2
    if not RESTS < gap < HOLLOW * 2 * middle:
        return points, normals
    low, stretch = added & (height < middle), middle / (middle - gap)
    down = np.where(low, (stretch - 1) * (middle - height), 0.0)
    # A surface that is stretched along one axis has normals that shrink along it.
    turned = normals + np.where(low, (1 / stretch - 1) * (normals @ up), 0.0)[:, None] * up
    return points - down[:, None] * up, turned / np.linalg.norm(turned, axis=1, keepdims=True)
