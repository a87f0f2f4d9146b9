"""Hard objects that are hollow, with thin walls and handles: what is held by a handle, or by a rim."""

from __future__ import annotations

import numpy as np

from dro_grasp.objects.builtin.construction import HARD_TEST, HARD_TRAIN, PORCELAIN, BuiltinObject
from dro_grasp.objects.solids import Pieces, arc, bar, box, circle, hull, rectangle, ring, spar, upright, vessel


def _saucepan() -> Pieces:
    """High walls, and a round handle near the rim."""
    body = vessel(circle, [(0.078, 0.0), (0.082, 0.006), (0.082, 0.095)], [(0.077, 0.003), (0.0798, 0.0072), (0.0798, 0.095)])
    line = np.array([(0.0805, 0.075), (0.11, 0.078), (0.15, 0.092), (0.255, 0.1)])
    return [body, bar(upright(line), circle(0.009, 10))]


def _basket() -> Pieces:
    """A box of wicker that opens upwards, and an arch over it."""
    body = vessel(lambda r: rectangle((0.09, 0.05), r, 4), [(0.03, 0.0), (0.05, 0.12)], [(0.0245, 0.006), (0.0445, 0.12)])
    arch = arc((0.1375, 0.17), (180, 0), 15, (0, 0.09))
    return [body, bar(upright(arch), rectangle((0.011, 0.003)), up=(1, 0, 0))]


def _tea_cup() -> Pieces:
    """A bowl on a foot, with an ear that takes one finger."""
    bowl = vessel(lambda r: circle(r, 18), [(0.02, 0.0), (0.033, 0.014), (0.042, 0.04), (0.046, 0.062)],
                  [(0.0185, 0.003), (0.0308, 0.0158), (0.0396, 0.0404), (0.0436, 0.062)])
    ear = arc((0.017, 0.019), (115, -133), 10, (0.047, 0.036))
    return [bowl, bar(upright(ear), circle(0.003, 8))]


def _frying_pan() -> Pieces:
    body = vessel(circle, [(0.105, 0.0), (0.122, 0.014), (0.14, 0.046)], [(0.1035, 0.003), (0.1198, 0.0156), (0.1375, 0.046)])
    handle = spar([(0.1275, 0.034, 0.006, 0.029), (0.17, 0.018, 0.009, 0.044), (0.24, 0.022, 0.013, 0.064),
                   (0.31, 0.026, 0.013, 0.07), (0.33, 0.018, 0.01, 0.07)])
    return [body, *handle]


def _steel_bucket() -> Pieces:
    """A rolled rim, and a bail of wire that stands up."""
    body = vessel(lambda r: circle(r, 20), [(0.1, 0.0), (0.14, 0.27)], [(0.0985, 0.002), (0.1382, 0.27)])
    ears = [box((0.012, 0.026, 0.03), (side * 0.1425, 0, 0.25)) for side in (1, -1)]
    bail = upright(arc((0.1445, 0.15), (180, 0), 17, (0, 0.25)))
    return [body, ring(0.1395, 0.004, 20, at=(0, 0, 0.268), start=np.pi / 20), *ears, bar(bail, circle(0.003, 8), up=(1, 0, 0))]


def _water_pitcher() -> Pieces:
    """A belly, a neck, a beak and a large handle."""
    body = vessel(lambda r: circle(r, 16), [(0.045, 0.0), (0.06, 0.06), (0.045, 0.165), (0.053, 0.21)],
                  [(0.042, 0.005), (0.057, 0.0602), (0.042, 0.165), (0.05, 0.21)])
    beak = hull(np.array([(-0.0505, 0.02, 0.21), (-0.0505, -0.02, 0.21), (-0.0455, 0.008, 0.175), (-0.0455, -0.008, 0.175),
                          (-0.074, 0.006, 0.215), (-0.074, -0.006, 0.215)]))
    line = np.array([(0.05, 0.197), (0.075, 0.203), (0.098, 0.185), (0.102, 0.15), (0.095, 0.105), (0.077, 0.068),
                     (0.0575, 0.055)])
    return [body, beak, bar(upright(line), rectangle((0.006, 0.0025), 0.0015, 2))]


OBJECTS: dict[str, BuiltinObject] = {
    "saucepan": BuiltinObject(_saucepan, HARD_TRAIN, mass=0.8),
    "basket": BuiltinObject(_basket, HARD_TRAIN, mass=0.45),
    "tea_cup": BuiltinObject(_tea_cup, HARD_TRAIN, density=PORCELAIN),
    "frying_pan": BuiltinObject(_frying_pan, HARD_TEST, mass=1.0),
    "steel_bucket": BuiltinObject(_steel_bucket, HARD_TEST, mass=0.9),
    "water_pitcher": BuiltinObject(_water_pitcher, HARD_TEST, mass=0.6),
}
"""Pans, cups and what water is carried in."""
