"""Hard objects of rods and rings: what offers thin rods with gaps that fingers go through."""

from __future__ import annotations

import numpy as np

from dro_grasp.objects.builtin.construction import HARD_TEST, HARD_TRAIN, STEEL, BuiltinObject
from dro_grasp.objects.solids import Pieces, arc, at_height, bar, circle, frustum, rectangle, ring, upright, washer


def _dish_rack() -> Pieces:
    """A frame with crossbars a little above its middle, rails a little below, and rods that stand on the rails."""
    section = circle(0.003, 8)
    frame = bar(at_height(rectangle((0.14, 0.09)), 0.0), section, closed=True)
    across = [frustum((0.0025, 0.0025), (-0.09, 0.09), (x, 0, 0.0008), axis="y", corners=8)
              for x in (-0.07, 0.0, 0.07)]
    rails = [frustum((0.0025, 0.0025), (-0.14, 0.14), (0, y, -0.0008), axis="x", corners=8) for y in (-0.035, 0.035)]
    rods = [frustum((0.002, 0.002), (-0.001, 0.11), (x, y, 0), corners=8)
            for x in np.linspace(-0.115, 0.115, 6) for y in (-0.035, 0.035)]
    return [frame, *across, *rails, *rods]


def _wire_stand() -> Pieces:
    """A ring on three bent legs."""
    leg = np.array([(0.058, 0.1), (0.07, 0.06), (0.074, 0.0), (0.095, 0.0)])
    places = np.radians([90, 210, 330])
    lines = [np.column_stack([leg[:, 0] * np.cos(a), leg[:, 0] * np.sin(a), leg[:, 1]]) for a in places]
    return [ring(0.058, 0.003, 20, at=(0, 0, 0.1)), ring(0.0725, 0.002, 20, at=(0, 0, 0.03)),
            *(bar(line, circle(0.0025, 8)) for line in lines)]


def _toast_rack() -> Pieces:
    """Six arches between two runners, and a ring on top to hold it by."""
    section = circle(0.0025, 8)
    line = np.concatenate([[(0.045, 0.0)], arc((0.045, 0.035), (0, 180), 9, (0, 0.06)), [(-0.045, 0.0)]])
    arches = [bar(upright(line, (x, 0, 0), "y"), section, up=(1, 0, 0)) for x in np.linspace(-0.075, 0.075, 6)]
    rods = [frustum((0.0028, 0.0028), (-0.09, 0.09), at, axis="x", corners=8)
            for at in ((0, 0.045, 0.003), (0, -0.045, 0.003), (0, 0, 0.095))]
    return [*arches, *rods, ring(0.02, 0.003, 14, axis="y", at=(0, 0, 0.116))]


def _towel_ring() -> Pieces:
    """A plate for the wall, a post, and the ring that it holds."""
    return [frustum((0.027, 0.027), (-0.046, -0.038), axis="y"), frustum((0.009, 0.009), (-0.039, 0.007), axis="y", corners=12),
            ring(0.083, 0.0045, 24, axis="y", at=(0, 0, -0.083))]


OBJECTS: dict[str, BuiltinObject] = {
    "dish_rack": BuiltinObject(_dish_rack, HARD_TRAIN, density=STEEL),
    "wire_stand": BuiltinObject(_wire_stand, HARD_TRAIN, density=STEEL),
    "bangle": BuiltinObject(lambda: [washer(circle(0.0345), circle(0.031), -0.006, 0.006)], HARD_TRAIN, density=STEEL),
    "toast_rack": BuiltinObject(_toast_rack, HARD_TEST, density=STEEL),
    "towel_ring": BuiltinObject(_towel_ring, HARD_TEST, mass=0.3),
}
"""Racks and rings of metal."""
