"""Hard objects that are flat: what is held across an edge, or lies on a table with no room below."""

from __future__ import annotations

import numpy as np

from dro_grasp.objects.builtin.construction import HARD_TEST, HARD_TRAIN, PORCELAIN, BuiltinObject
from dro_grasp.objects.solids import (
    Pieces,
    arc,
    bar,
    box,
    circle,
    frustum,
    hull,
    placed,
    rectangle,
    slab,
    upright,
    vessel,
    washer,
)


def _ruler() -> Pieces:
    """One long edge is bevelled."""
    section = np.array([(0.017, -0.00125), (0.017, -0.0005), (0.009, 0.00125), (-0.017, 0.00125), (-0.017, -0.00125)])
    return [hull(np.concatenate([np.column_stack([np.full(5, x), section]) for x in (-0.155, 0.155)]))]


def _serving_tray() -> Pieces:
    """A floor with a rim that leans out, and a grip that stands on each short side."""
    half = (0.165, 0.105)
    tray = vessel(lambda r: rectangle(half, r, 5), [(0.02, 0.0), (0.035, 0.03)], [(0.0175, 0.004), (0.0315, 0.03)])
    line = np.array([(-0.06, 0.024), (-0.055, 0.052), (0.055, 0.052), (0.06, 0.024)])
    grips = [bar(upright(line, (side * 0.198, 0, 0), "y"), circle(0.004, 8), up=(1, 0, 0)) for side in (1, -1)]
    return [tray, *grips]


def _chopping_board() -> Pieces:
    """A board, and a handle with a hole."""
    outer = rectangle((0.012, 0.018), 0.022, 5)
    hole = arc((0.012, 0.016), (9, 369), 20, closed=True)
    grip = placed(washer(outer, hole, -0.008, 0.008), (0.145, 0, 0))
    return [slab(rectangle((0.105, 0.07), 0.015, 4), -0.008, 0.008), grip]


def _dinner_plate() -> Pieces:
    return [vessel(circle, [(0.076, 0.0), (0.09, 0.006), (0.134, 0.021)], [(0.073, 0.005), (0.088, 0.0105), (0.134, 0.0245)])]


def _hardcover_book() -> Pieces:
    """Pages between two covers that stand out on three sides, and a round back."""
    covers = [box((0.147, 0.215, 0.003), (0, 0, side * 0.0125)) for side in (1, -1)]
    back = arc((0.006, 0.014), (90, 270), 9, (-0.071, 0))
    spine = hull(np.concatenate([upright(back, (0, y, 0)) for y in (-0.1075, 0.1075)]))
    return [*covers, box((0.14, 0.205, 0.0242), (-0.0015, 0, 0)), spine]


OBJECTS: dict[str, BuiltinObject] = {
    "coaster": BuiltinObject(lambda: [frustum((0.048, 0.048), (-0.0025, 0.0025), corners=32)], HARD_TRAIN),
    "ruler": BuiltinObject(_ruler, HARD_TRAIN, mass=0.03),
    "serving_tray": BuiltinObject(_serving_tray, HARD_TRAIN, mass=0.9),
    "chopping_board": BuiltinObject(_chopping_board, HARD_TRAIN),
    "dinner_plate": BuiltinObject(_dinner_plate, HARD_TEST, density=PORCELAIN),
    "hardcover_book": BuiltinObject(_hardcover_book, HARD_TEST, mass=0.5),
    # Size and radius of the corners of an ID-1 card. Source: ISO/IEC 7810.
    "bank_card": BuiltinObject(lambda: [slab(rectangle((0.03962, 0.02381), 0.00318, 4), -0.00038, 0.00038)], HARD_TEST,
                               mass=0.005),
}
"""Things of paper, wood and porcelain."""
