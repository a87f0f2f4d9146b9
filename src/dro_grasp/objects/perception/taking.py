"""One object out of a scene: its unseen side completed, without what would be in the table or in other things."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from dro_grasp.errors import ObjectError
from dro_grasp.geometry.table_plane import moved_plane
from dro_grasp.objects.loading import MIN_CLOUD, cloud_object
from dro_grasp.objects.perception.choosing import Chosen, Sight
from dro_grasp.objects.perception.scan import scanned_object
from dro_grasp.objects.perception.segmentation import Segments
from dro_grasp.objects.perception.things import place_of
from dro_grasp.objects.shape import ObjectModel

CLEAR = 0.006  # Completed points nearer to what was seen of other things are left out [m] (ours)
ON_OTHERS = 0.01  # What is this near to other things may lie on them, and not on the plane [m] (ours)


def taken_object(name: str, sight: Sight, segments: Segments, chosen: Chosen) -> ObjectModel:
    """The object of the chosen points in the scene's frame, with the plane below it as its table."""
    points = sight.points[chosen.own]
    below = None if chosen.below is None else segments.planes[chosen.below]
    table = None if below is None else moved_plane(below, sight.T)
    if not sight.from_camera:
        obj = cloud_object(name, points, origin=name, keep_table=True)
        return replace(obj, table=table, notes=(*obj.notes, *chosen.notes))
    others = KDTree(sight.world()[chosen.others]) if len(chosen.others) else None
    rests = others is None or others.query(sight.world()[chosen.own])[0].min() > ON_OTHERS
    up = None if below is None else below[:3]
    whole = scanned_object(name, points, sight.T, keep_table=True, up=up, table=below if rests else None)
    cloud, kept = whole.cloud.astype(np.float64), np.ones(len(whole.cloud), bool)
    if table is not None:
        kept &= cloud @ table[:3] > table[3]
    if others is not None:
        kept &= others.query(cloud)[0] > CLEAR
    if kept.sum() < MIN_CLOUD:
        place = place_of(sight.world()[chosen.own])
        raise ObjectError(f"of the thing at {place} in '{name}', {int(kept.sum())} of {len(kept)} points are above the plane "
                          "below it and apart from other things; look at a picture of the scene (draw_scene), and mean another "
                          "thing, or give its pixels (mask=PNG)")
    rows = np.concatenate([cloud[kept], whole.cloud_normals[kept].astype(np.float64)], 1)
    obj = cloud_object(name, rows, origin=name, keep_table=True, seen=whole.seen)
    return replace(obj, table=table, notes=(*whole.notes, *chosen.notes))
