"""Hard objects that are large: what a whole hand must span, or two palms."""

from __future__ import annotations

from dro_grasp.objects.builtin.construction import HARD_TEST, HARD_TRAIN, BuiltinObject
from dro_grasp.objects.solids import box, superquadric

OBJECTS: dict[str, BuiltinObject] = {
    "carton": BuiltinObject(lambda: [box((0.3, 0.25, 0.2))], HARD_TRAIN, mass=1.2),
    "rugby_ball": BuiltinObject(lambda: [superquadric((0.14, 0.095, 0.095), (1, 1))], HARD_TRAIN, mass=0.43),
    "parcel": BuiltinObject(lambda: [box((0.28, 0.2, 0.2))], HARD_TEST, mass=2.0),
    "football": BuiltinObject(lambda: [superquadric((0.11, 0.11, 0.11), (1, 1))], HARD_TEST, mass=0.43),
}
"""Boxes and balls."""
