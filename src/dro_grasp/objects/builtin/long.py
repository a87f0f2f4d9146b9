"""Hard objects that are long and thin: what two fingers pinch, and what turns about their line."""

from __future__ import annotations

import numpy as np

from dro_grasp.objects.builtin.construction import HARD_TEST, HARD_TRAIN, STEEL, BuiltinObject
from dro_grasp.objects.solids import (
    Pieces,
    arc,
    at_height,
    bar,
    box,
    circle,
    frustum,
    placed,
    rectangle,
    slab,
    spar,
    superquadric,
    vessel,
)


def _pencil() -> Pieces:
    barrel = frustum((0.0038, 0.0038), (-0.08, 0.067), axis="x", corners=6)
    point = frustum((0.0038, 0.0005), (0.067, 0.086), axis="x", corners=6)
    return [barrel, point, frustum((0.0035, 0.0035), (-0.094, -0.079), axis="x", corners=12)]


def _table_spoon() -> Pieces:
    outer, inner = [(0.012, 0.0), (0.019, 0.004), (0.022, 0.0095)], [(0.0115, 0.0014), (0.0179, 0.0051), (0.0208, 0.0095)]
    bowl = placed(vessel(lambda r: circle(r, 20), outer, inner), (-0.075, 0, 0), stretch=(1.5, 1, 1))
    handle = spar([(-0.045, 0.011, 0.002, 0.0085), (-0.03, 0.007, 0.0035, 0.0125), (0.03, 0.008, 0.003, 0.0115),
                   (0.085, 0.019, 0.002, 0.004), (0.098, 0.012, 0.002, 0.003)])
    return [bowl, *handle]


def _pliers() -> Pieces:
    jaw = np.array([(0.052, -0.0045), (0.052, 0.0045), (0.0, 0.0135), (-0.014, 0.01), (-0.014, -0.01), (0.0, -0.0135)])
    line = np.array([(0.0, 0.0), (-0.03, 0.012), (-0.07, 0.026), (-0.11, 0.027), (-0.135, 0.021)])
    handles = [bar(at_height(line * (1, side), 0.0), rectangle((0.0045, 0.0055))) for side in (1, -1)]
    return [slab(jaw, -0.005, 0.005), frustum((0.011, 0.011), (-0.0065, 0.0065)), *handles]


def _ballpoint_pen() -> Pieces:
    clip = [box((0.042, 0.0035, 0.0012), (-0.042, 0, 0.0082)), box((0.005, 0.0035, 0.0058), (-0.0605, 0, 0.0059))]
    return [frustum((0.0055, 0.0055), (-0.068, 0.05), axis="x", corners=16), *clip,
            frustum((0.0055, 0.0012), (0.05, 0.07), axis="x", corners=16),
            frustum((0.0027, 0.0027), (-0.077, -0.067), axis="x", corners=12)]


def _flute() -> Pieces:
    keys = [frustum((0.0075, 0.0075), (0.0075, 0.0125), (x, 0, 0), corners=12) for x in np.linspace(-0.02, 0.26, 10)]
    rod = frustum((0.002, 0.002), (-0.03, 0.27), (0, 0.0105, 0.004), axis="x", corners=8)
    lip_plate = superquadric((0.019, 0.012, 0.004), (0.6, 0.8), (-0.24, 0, 0.009))
    return [frustum((0.0095, 0.0095), (-0.33, 0.33), axis="x"), lip_plate, rod, *keys]


def _table_fork() -> Pieces:
    handle = spar([(-0.105, 0.014, 0.002, 0.0), (-0.09, 0.02, 0.0025, 0.001), (-0.01, 0.0075, 0.0035, 0.009),
                   (0.03, 0.008, 0.0035, 0.006), (0.046, 0.023, 0.002, -0.001), (0.06, 0.024, 0.002, -0.003)])
    tine = spar([(0.0585, 0.0032, 0.002, -0.0029), (0.085, 0.003, 0.0018, -0.003), (0.105, 0.0014, 0.001, 0.004)])
    return [*handle, *(placed(part, (0, y, 0)) for y in (-0.0104, -0.0035, 0.0035, 0.0104) for part in tine)]


def _scissors() -> Pieces:
    """Closed scissors: of each half the blade on one side of the pivot, and the loop on the other."""
    blade = np.array([(0.096, -0.001), (0.09, 0.0022), (0.0, 0.009), (-0.014, 0.003), (-0.014, -0.005), (0.0, -0.008)])
    pieces = [frustum((0.005, 0.005), (-0.0035, 0.0035), corners=16)]
    for side in (1, -1):
        low, high = sorted((-0.0002 * side, 0.002 * side))
        middle = (low + high) / 2
        shank = np.array([(-0.006, 0.0), (-0.026, 0.0085), (-0.047, 0.013)]) * (1, side)
        loop = arc((0.031, 0.02), (0, 360), 16, closed=True)
        pieces += [slab(blade[:: side] * (1, side), low, high),
                   bar(at_height(shank, middle), rectangle((0.005, (high - low) / 2))),
                   placed(bar(at_height(loop, 0.0), rectangle((0.003, 0.004)), closed=True), (-0.072, 0.0265 * side, 0),
                          (0, 0, -22 * side))]
    return pieces


OBJECTS: dict[str, BuiltinObject] = {
    "pencil": BuiltinObject(_pencil, HARD_TRAIN, mass=0.006),
    "chopstick": BuiltinObject(lambda: [frustum((0.0048, 0.0018), (-0.12, 0.12), axis="x", corners=4)], HARD_TRAIN),
    "table_spoon": BuiltinObject(_table_spoon, HARD_TRAIN, density=STEEL),
    "pliers": BuiltinObject(_pliers, HARD_TRAIN, mass=0.24),
    "ballpoint_pen": BuiltinObject(_ballpoint_pen, HARD_TEST, mass=0.011),
    "flute": BuiltinObject(_flute, HARD_TEST, mass=0.42),
    "table_fork": BuiltinObject(_table_fork, HARD_TEST, density=STEEL),
    "scissors": BuiltinObject(_scissors, HARD_TEST, mass=0.09),
}
"""Pens, cutlery and tools."""
