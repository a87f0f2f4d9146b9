"""Hard objects that are small: what the tips of two fingers pick up."""

from __future__ import annotations

import numpy as np

from dro_grasp.objects.builtin.construction import ACRYLIC, BRASS, HARD_TEST, HARD_TRAIN, STEEL, BuiltinObject
from dro_grasp.objects.solids import Loop, Pieces, box, circle, frustum, hull, spar, washer


def _hex_bolt() -> Pieces:
    """M12 x 60; the head is 18 mm across flats and 7.5 mm high. Source: ISO 4017."""
    return [frustum((0.018 / np.sqrt(3), 0.018 / np.sqrt(3)), (0.0, 0.0075), corners=6),
            frustum((0.006, 0.006), (-0.06, 0.001), corners=16)]


def _door_key() -> Pieces:
    """A bow with a hole, a blade and three bits."""
    bits = [box((0.004, depth + 0.001, 0.0024), (x, -0.003 - depth / 2, 0))
            for x, depth in ((0.028, 0.0025), (0.036, 0.004), (0.043, 0.002))]
    return [washer(circle(0.0125, 20), circle(0.004, 20), -0.0012, 0.0012),
            *spar([(0.0105, 0.009, 0.0024, 0), (0.047, 0.007, 0.0024, 0), (0.05, 0.003, 0.0024, 0)]), *bits]


def _hexagon(across: float, between: int) -> Loop:
    """A hexagon of a distance across flats [m], with points between its corners."""
    corners = circle(across / np.sqrt(3), 6)
    share = np.arange(between + 1)[:, None] / (between + 1)
    return np.concatenate([a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])


def _playing_die() -> Pieces:
    """Its edges are cut."""
    corners = np.array([np.roll((a * 0.008, b * 0.0065, c * 0.0065), k)
                        for k in range(3) for a in (1, -1) for b in (1, -1) for c in (1, -1)])
    return [hull(corners)]


OBJECTS: dict[str, BuiltinObject] = {
    "hex_bolt": BuiltinObject(_hex_bolt, HARD_TRAIN, density=STEEL),
    "door_key": BuiltinObject(_door_key, HARD_TRAIN, density=BRASS),
    # M20: 30 mm across flats and 16 mm high. Source: ISO 4032, rounded.
    "hex_nut": BuiltinObject(lambda: [washer(_hexagon(0.03, 3), circle(0.01), -0.008, 0.008)], HARD_TEST, density=STEEL),
    "playing_die": BuiltinObject(_playing_die, HARD_TEST, density=ACRYLIC),
}
"""Hardware, a key and a die."""
