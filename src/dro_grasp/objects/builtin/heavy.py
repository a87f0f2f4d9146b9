"""Hard objects of iron: what slides out of a grasp that holds anything else of its size."""

from __future__ import annotations

import numpy as np

from dro_grasp.objects.builtin.construction import HARD_TEST, HARD_TRAIN, IRON, BuiltinObject
from dro_grasp.objects.solids import Pieces, arc, at_height, bar, box, circle, frustum, hull, rectangle, superquadric, upright


def _iron_ingot() -> Pieces:
    """A bar as it comes out of its mould."""
    return [hull(np.concatenate([at_height(rectangle((0.08, 0.03)), 0.0), at_height(rectangle((0.07, 0.022)), 0.038)]))]


def _kettlebell() -> Pieces:
    """A ball that stands on a foot, with a handle above."""
    handle = np.concatenate([[(0.036, 0.025)], arc((0.045, 0.028), (-10, 190), 9, (0, 0.08)), [(-0.036, 0.025)]])
    return [superquadric((0.047, 0.047, 0.047), (1, 1)), frustum((0.032, 0.036), (-0.047, -0.028)),
            bar(upright(handle), circle(0.011, 10), up=(0, 1, 0))]


def _hex_dumbbell() -> Pieces:
    heads = [frustum((0.042, 0.042), heights, axis="x", corners=6) for heights in ((-0.11, -0.064), (0.064, 0.11))]
    return [frustum((0.0145, 0.0145), (-0.066, 0.066), axis="x", corners=16), *heads]


def _iron_block() -> Pieces:
    """A block with a step."""
    return [box((0.1, 0.06, 0.024), (0, 0, -0.012)), box((0.058, 0.06, 0.03), (-0.021, 0, 0.014))]


OBJECTS: dict[str, BuiltinObject] = {
    "iron_ingot": BuiltinObject(_iron_ingot, HARD_TRAIN, density=IRON),
    "kettlebell": BuiltinObject(_kettlebell, HARD_TRAIN, density=IRON),
    "hex_dumbbell": BuiltinObject(_hex_dumbbell, HARD_TEST, density=IRON),
    "iron_block": BuiltinObject(_iron_block, HARD_TEST, density=IRON),
}
"""Blocks and weights."""
