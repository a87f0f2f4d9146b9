"""Whether a cloud is one thing: several that stand apart are a scene, of which one has to be chosen."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from dro_grasp.errors import ObjectError
from dro_grasp.geometry.point_groups import separate_groups
from dro_grasp.objects.perception.segmentation import CERTAIN_AREA, STRUCTURE, segment

MOST_TOLD = 6  # Things that a message lists (ours)
BARE = 0.25  # Area from which a plane alone is a table without a thing on it [m^2] (ours)
UNTOLD = 0.01  # Largest share of scattered points that is not worth a word (ours)
LIKELY = 0.5  # Extent up to which a cloud is taken for an object without asking [m] (ours)
AS_SCENE = ("give it as a scene, of which one thing is meant (scene=FILE camera=JSON, and nearest=True, at=(X, Y, Z) or "
            "pixel=(U, V); load_scene and object_at in Python)")  # What to do with a scene
AS_IMAGE = f". If it is a depth image, {AS_SCENE}; the camera's file states the intrinsics"  # What to do with an image


def one_thing(
    points: Float[np.ndarray, "n 3"], on_table: bool, origin: str
) -> tuple[Int[np.ndarray, " _"], tuple[str, ...]]:
    """The points of the one thing of a cloud [m], and what to say of it.

    Of what stood on a table, scattered points are left out. Without one, all points stay.

    Raises:
        ObjectError: Several things stand on the table.
    """
    every = np.arange(len(points))
    things = separate_groups(points) if len(points) else []
    if len(things) > 1:
        told = "; ".join(f"{size_of(points[own])} about {place_of(points[own])} m" for own in things[:MOST_TOLD])
        said = f"{len(things)} things that stand apart ({told}{'; ...' if len(things) > MOST_TOLD else ''})"
        if on_table:
            raise ObjectError(
                f"{origin} is a view of a table with {said}; {AS_SCENE}; or keep all points as one object with "
                "keep_table=True")
        return every, (f"it is {said}, and all of them count as one object; if it is a view, {AS_SCENE}",)
    if not on_table or not things or len(things[0]) == len(points):
        return every, ()
    left = len(points) - len(things[0])
    return np.sort(things[0]), (f"{left} scattered points beside it were left out",) if left > UNTOLD * len(points) else ()


def refuse_scene(points: Float[np.ndarray, "n 3"], kept: Float[np.ndarray, "m 3"], origin: str) -> None:
    """Refuse a cloud, of which some points are taken for the object [m], that shows a room: ObjectError."""
    if not len(kept) or np.ptp(kept, axis=0).max() <= LIKELY:
        return
    shown = segment(points)
    if not shown.count and len(shown.areas) == 1 and shown.areas[0] > BARE and (shown.labels == STRUCTURE).mean() > 0.95:
        raise ObjectError(f"{origin} shows a plane of {shown.areas[0]:.2f} m² and nothing on it, as of a bare table; look at "
                          "the object, or keep all points as one object with keep_table=True")
    if not shown.count or max(shown.areas, default=0.0) < CERTAIN_AREA:
        return
    things = "1 thing" if shown.count == 1 else f"{shown.count} things"
    raise ObjectError(f"{origin} is a scene, and no object: it is {np.ptp(points, axis=0).max():.2f} m long and shows a plane "
                      f"of {max(shown.areas):.2f} m² and {things} beside it; {AS_SCENE}; or keep all points as one object with "
                      "keep_table=True")


def size_of(points: Float[np.ndarray, "n 3"]) -> str:
    """The extents of points in words."""
    return " x ".join(f"{100 * extent:.0f}" for extent in np.ptp(points, axis=0)) + " cm"


def place_of(points: Float[np.ndarray, "n 3"]) -> str:
    """The middle of points in words [m]."""
    return " ".join(f"{value + 0.0:.2f}" for value in (points.min(0) + points.max(0)) / 2)
