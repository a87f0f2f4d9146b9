"""A URDF mirrored or scaled, in place: kinematics, shapes, meshes and inertias alike."""

from __future__ import annotations

import xml.etree.ElementTree as ET

from dro_grasp.descriptions.urdf import MOVING

LENGTHS = {"box": ("size",), "cylinder": ("radius", "length"), "capsule": ("radius", "length"), "sphere": ("radius",),
           "mesh": ("scale",)}
"""Attributes of each shape that are lengths [m], or factors of lengths."""
DEFAULTS = {"xyz": (0.0, 0.0, 0.0), "rpy": (0.0, 0.0, 0.0), "scale": (1.0, 1.0, 1.0)}
"""Values of attributes that are left out; a joint's axis is x."""


def mirror(root: ET.Element) -> None:
    """Turn a hand into its mirror image at the plane y = 0 of its root link, and so a right hand into a left one.

    Every link's frame is mirrored alike: equal joint values give mirrored poses. Meshes get a negative scale along y, which
    MuJoCo and trimesh take as a mirror image with its faces outwards; no mesh is written.
    """
    for origin in root.iter("origin"):
        _change(origin, "xyz", (1, -1, 1))
        _change(origin, "rpy", (-1, 1, -1))
    for mesh in root.iter("mesh"):
        _change(mesh, "scale", (1, -1, 1))
    for joint in _moving_joints(root):
        axis = joint.find("axis")
        axis = ET.SubElement(joint, "axis", xyz="1 0 0") if axis is None else axis
        # An axis of rotation is a pseudovector: its mirror image turns the other way.
        _change(axis, "xyz", (1, -1, 1) if _slides(joint) else (-1, 1, -1))
    for inertia in root.iter("inertia"):
        for name in ("ixy", "iyz"):
            _change(inertia, name, (-1,))


def scale(root: ET.Element, factor: float) -> None:
    """Make a hand larger or smaller by a factor, at the same densities: masses grow with its cube. Efforts stay.

    Args:
        root: The `<robot>` element, changed in place.
        factor: Positive.
    """
    for origin in root.iter("origin"):
        _change(origin, "xyz", (factor,) * 3)
    for shape, attributes in LENGTHS.items():
        for element in root.iter(shape):
            for name in attributes:
                _change(element, name, (factor,) * 3)
    for mass in root.iter("mass"):
        _change(mass, "value", (factor**3,))
    for inertia in root.iter("inertia"):
        for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"):
            _change(inertia, name, (factor**5,))
    slides = {joint.get("name", ""): _slides(joint) for joint in root.findall("joint")}
    for joint in _moving_joints(root):
        own = factor if _slides(joint) else 1.0
        for limit in joint.findall("limit"):
            for name in ("lower", "upper", "velocity"):
                _change(limit, name, (own,))
        for mimic in joint.findall("mimic"):
            leader = factor if slides.get(mimic.get("joint", "")) else 1.0
            _change(mimic, "offset", (own,))
            if own != leader:
                mimic.set("multiplier", f"{float(mimic.get('multiplier', '1')) * own / leader:.9g}")


def _moving_joints(root: ET.Element) -> list[ET.Element]:
    return [joint for joint in root.findall("joint") if joint.get("type") in MOVING]


def _slides(joint: ET.Element) -> bool:
    return joint.get("type") == "prismatic"


def _change(element: ET.Element, name: str, factors: tuple[float, ...]) -> None:
    """Multiply the numbers of an attribute; one that is left out keeps its default, unless that changes."""
    text = element.get(name)
    values = DEFAULTS.get(name, ()) if text is None else [float(x) for x in text.split()]
    changed = [value * factor for value, factor in zip(values, factors, strict=False)]
    if changed != list(values):
        element.set(name, " ".join(f"{x + 0.0:.9g}" for x in changed))
