"""Built-in objects of a size and shape that most hands hold, for training and tests."""

from __future__ import annotations

import numpy as np

from dro_grasp.objects.builtin.construction import BuiltinObject
from dro_grasp.objects.solids import Pieces, box, frustum, hollow, hull, ring, superquadric, tilted, turned


def _teapot() -> Pieces:
    profile = [(0.03, -0.045), (0.05, -0.02), (0.05, 0.015), (0.03, 0.04), (0.012, 0.045), (0.012, 0.058)]
    spout = hull(np.concatenate([
        frustum((0.012, 0.012), (-0.008, 0.008), (0.045, 0, -0.01)).vertices,
        frustum((0.007, 0.007), (-0.003, 0.003), (0.085, 0, 0.03)).vertices,
    ]))
    return [*turned(profile), spout, ring(0.026, 0.006, 9, arc=np.pi, axis="y", at=(-0.044, 0, 0), start=np.pi)]


def _hammer() -> Pieces:
    head = (0, 0, 0.075)
    return [frustum((0.013, 0.011), (-0.09, 0.07)), frustum((0.016, 0.016), (-0.035, 0.04), head, axis="x"),
            frustum((0.016, 0.006), (-0.06, -0.035), head, axis="x")]


def _wrench() -> Pieces:
    jaw = [box((0.012, 0.028, 0.014), (x, 0, 0.078)) for x in (0.014, -0.014)]
    return [box((0.02, 0.014, 0.15), (0, 0, -0.005)), box((0.04, 0.028, 0.018), (0, 0, 0.066)), *jaw]


def _spray_bottle() -> Pieces:
    body = turned([(0.036, -0.08), (0.036, 0.02), (0.016, 0.05), (0.016, 0.065)])
    return [*body, box((0.075, 0.026, 0.028), (0.012, 0, 0.078)), box((0.01, 0.016, 0.04), (0.04, 0, 0.048))]


def _camera() -> Pieces:
    lens = frustum((0.027, 0.025), (0.018, 0.055), axis="y")
    return [box((0.11, 0.04, 0.07)), lens, box((0.035, 0.03, 0.014), (0, 0, 0.041))]


def _dumbbell() -> Pieces:
    ends = [frustum((0.033, 0.033), heights, axis="x") for heights in ((-0.075, -0.04), (0.04, 0.075))]
    return [frustum((0.014, 0.014), (-0.041, 0.041), axis="x"), *ends]


def _airplane() -> Pieces:
    body = [frustum((0.016, 0.012), (-0.07, 0.06), axis="x"), frustum((0.012, 0.002), (0.06, 0.085), axis="x")]
    tail = [box((0.022, 0.06, 0.008), (-0.06, 0, 0.005)), box((0.022, 0.008, 0.04), (-0.06, 0, 0.025))]
    return [*body, box((0.04, 0.17, 0.012), (0.005, 0, 0)), *tail]


def _duck() -> Pieces:
    beak = hull(np.concatenate([
        frustum((0.011, 0.011), (0.02, 0.022), (0.018, 0, 0.045), axis="x").vertices,
        frustum((0.004, 0.004), (0.036, 0.038), (0.018, 0, 0.042), axis="x").vertices,
    ]))
    body = superquadric((0.046, 0.034, 0.03), (1, 1))
    head = superquadric((0.024, 0.024, 0.024), (1, 1), (0.022, 0, 0.043))
    return [body, head, beak, tilted(box((0.03, 0.03, 0.012), (-0.045, 0, 0.0)), 0.5)]


def _joystick() -> Pieces:
    base, stick = turned([(0.045, -0.05), (0.04, -0.03)]), frustum((0.014, 0.014), (-0.031, 0.03))
    return [*base, stick, superquadric((0.022, 0.022, 0.026), (1, 1), (0, 0, 0.045))]


def _chess_pawn() -> Pieces:
    profile = [(0.032, -0.05), (0.032, -0.04), (0.022, -0.03), (0.012, 0.0), (0.012, 0.02), (0.02, 0.024), (0.02, 0.028)]
    return [*turned(profile), superquadric((0.021, 0.021, 0.021), (1, 1), (0, 0, 0.044))]


def _wine_glass() -> Pieces:
    stem = turned([(0.034, -0.085), (0.034, -0.08), (0.006, -0.074), (0.006, -0.015), (0.02, 0.0), (0.034, 0.02)])
    cup = hollow([(0.034, 0.0), (0.037, 0.03), (0.032, 0.06)], wall=0.005, floor=0.005)
    return [*stem, cup.moved((0, 0, 0.019))]


OBJECTS: dict[str, BuiltinObject] = {name: BuiltinObject(make, split) for name, make, split in (
    ("sphere", lambda: [superquadric((0.035, 0.035, 0.035), (1, 1))], "train"),
    ("ball", lambda: [superquadric((0.045, 0.045, 0.045), (1, 1))], "train"),
    ("egg", lambda: [superquadric((0.026, 0.026, 0.036), (1, 1))], "train"),
    ("ellipsoid", lambda: [superquadric((0.03, 0.04, 0.055), (1, 1))], "train"),
    ("cube", lambda: [box((0.05, 0.05, 0.05))], "train"),
    ("brick", lambda: [box((0.05, 0.07, 0.11))], "train"),
    ("flat_box", lambda: [box((0.09, 0.12, 0.035))], "train"),
    ("tall_box", lambda: [box((0.045, 0.06, 0.15))], "train"),
    ("rounded_box", lambda: [superquadric((0.03, 0.04, 0.05), (0.35, 0.35))], "train"),
    ("pillow", lambda: [superquadric((0.055, 0.045, 0.025), (0.8, 0.5))], "train"),
    ("octahedron", lambda: [superquadric((0.045, 0.045, 0.05), (2, 2))], "train"),
    ("spindle", lambda: [superquadric((0.03, 0.03, 0.07), (1.8, 1))], "train"),
    ("rod", lambda: [frustum((0.018, 0.018), (-0.08, 0.08))], "train"),
    ("can", lambda: [frustum((0.033, 0.033), (-0.06, 0.06))], "train"),
    ("tin", lambda: [frustum((0.045, 0.045), (-0.025, 0.025))], "train"),
    ("cone", lambda: [frustum((0.045, 0.004), (-0.05, 0.06))], "train"),
    ("prism", lambda: [frustum((0.04, 0.04), (-0.05, 0.05), corners=3)], "train"),
    ("hexagon", lambda: [frustum((0.035, 0.035), (-0.045, 0.045), corners=6)], "train"),
    ("pyramid", lambda: [frustum((0.055, 0.003), (-0.035, 0.05), corners=4)], "train"),
    ("bottle", lambda: turned([(0.034, -0.09), (0.036, -0.08), (0.036, 0.02), (0.014, 0.06), (0.014, 0.09)]), "train"),
    ("jar", lambda: turned(
        [(0.036, -0.05), (0.04, -0.04), (0.04, 0.03), (0.034, 0.038), (0.036, 0.04), (0.036, 0.055)]), "train"),
    ("vase", lambda: turned([(0.025, -0.075), (0.04, -0.03), (0.036, 0.01), (0.018, 0.05), (0.026, 0.075)]), "train"),
    ("cup", lambda: [hollow([(0.03, -0.045), (0.034, 0.0), (0.038, 0.045)], wall=0.006, floor=0.006)], "train"),
    ("bowl", lambda: [hollow([(0.03, -0.025), (0.05, -0.005), (0.062, 0.025)], wall=0.008, floor=0.008)], "train"),
    ("torus", lambda: [ring(0.045, 0.015)], "train"),
    ("l_block", lambda: [box((0.04, 0.04, 0.11)), box((0.05, 0.04, 0.04), (0.045, 0, -0.035))], "train"),
    ("t_block", lambda: [box((0.036, 0.036, 0.1)), box((0.11, 0.036, 0.036), (0, 0, 0.068))], "train"),
    ("cross", lambda: [box((0.12, 0.034, 0.034)), box((0.034, 0.12, 0.034))], "train"),
    ("hammer", _hammer, "train"),
    ("dumbbell", _dumbbell, "train"),
    ("light_bulb", lambda: [superquadric((0.032, 0.032, 0.032), (1, 1), (0, 0, 0.02)),
                            *turned([(0.014, -0.045), (0.014, -0.02), (0.026, 0.005)])], "train"),
    ("toy_airplane", _airplane, "train"),
    ("joystick", _joystick, "train"),
    ("wrench", _wrench, "train"),
    ("mug", lambda: [hollow([(0.036, -0.045), (0.038, 0.0), (0.04, 0.045)], wall=0.006, floor=0.006),
                     ring(0.026, 0.006, 9, arc=np.pi, axis="y", at=(0.036, 0, 0))], "test"),
    ("teapot", _teapot, "test"),
    ("screwdriver", lambda: [*turned([(0.012, -0.09), (0.017, -0.075), (0.017, -0.02), (0.010, -0.005)]),
                             frustum((0.0045, 0.0045), (-0.005, 0.09))], "test"),
    ("spray_bottle", _spray_bottle, "test"),
    ("camera", _camera, "test"),
    ("rubber_duck", _duck, "test"),
    ("chess_pawn", _chess_pawn, "test"),
    ("wine_glass", _wine_glass, "test"),
    ("lemon", lambda: [superquadric((0.028, 0.028, 0.04), (1.2, 1))], "test"),
    ("soap", lambda: [superquadric((0.045, 0.03, 0.02), (0.6, 0.6))], "test"),
)}
"""The usual ones. Test objects never enter a training bundle."""


