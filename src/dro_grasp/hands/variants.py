"""Variants of a hand: its mirror image, and larger or smaller ones; kinematics, shapes, meshes and inertias alike."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path

from dro_grasp.errors import HandError, OptionError
from dro_grasp.files import command
from dro_grasp.hands.description.loader import part_of_urdf
from dro_grasp.hands.description.urdf import MOVING, mesh_of
from dro_grasp.hands.description.xml_files import parse_xml
from dro_grasp.hands.library import locate_hand
from dro_grasp.kinds import checked

POWERS = {"origin": {"xyz": 1}, "box": {"size": 1}, "cylinder": {"radius": 1, "length": 1}, "sphere": {"radius": 1},
          "capsule": {"radius": 1, "length": 1}, "mesh": {"scale": 1}, "mass": {"value": 3},
          "inertia": dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), 5)}
"""How attributes of each element grow with a hand of constant density: powers of the factor of all lengths."""
DEFAULTS = {"xyz": (0.0, 0.0, 0.0), "rpy": (0.0, 0.0, 0.0), "scale": (1.0, 1.0, 1.0)}
"""Values of attributes that are left out; a joint's axis is x."""


@checked
def vary_hand(name: str | Path, *, mirrored: bool = False, factor: float = 1.0) -> str:
    """The URDF of a hand's mirror image, of a scaled hand, or of both.

    Meshes stay where they are: the text names them by their absolute paths.

    Args:
        name: A hand's name or file, as for `load_hand`.
        mirrored: At the plane y = 0 of the root link. Equal joint values give mirrored poses.
        factor: Of all lengths, 1 for the same size.

    Raises:
        HandError: No such hand, or it is not a URDF.
        OptionError: The factor is not positive.
    """
    if not (math.isfinite(factor) and factor > 0):
        raise OptionError(f"factor is {factor}; give a positive number, for example 1.2")
    path, _, link = locate_hand(name)
    root = parse_xml(path)
    if root.tag != "robot":
        raise HandError(f"{path} starts with <{root.tag}>; only a URDF (<robot>) can be mirrored or scaled")
    if link is not None:
        part_of_urdf(root, link, path)
    for mesh in root.iter("mesh"):
        file = mesh_of(mesh.get("filename", ""), path)
        if file is not None:
            mesh.set("filename", str(file))
    try:
        if mirrored:
            mirror(root)
        if factor != 1:
            scale(root, factor)
    except ValueError as error:
        check = command("dro-grasp", "hand", "check", name)
        raise HandError(f"{path}: {error}; expected numbers, see `{check}`") from error
    ET.indent(root)
    return f'<?xml version="1.0"?>\n{ET.tostring(root, encoding="unicode")}\n'


def vary_postures(name: str | Path, *, factor: float = 1.0) -> str | None:
    """The SRDF of a variant, with the postures that the SRDF beside a hand's URDF states; None where there is none.

    Equal joint values are the mirrored posture; what slides grows with the hand.

    Raises:
        HandError: No such hand, or its files are no XML or hold no numbers.
    """
    path = locate_hand(name).path
    if not (srdf := path.with_suffix(".srdf")).is_file():
        return None
    slides = {joint.get("name") for joint in parse_xml(path).findall("joint") if _slides(joint)}
    root = parse_xml(srdf)
    for joint in (joint for state in root.iter("group_state") for joint in state.iter("joint")):
        if joint.get("name") in slides:
            try:
                _change(joint, "value", (factor,))
            except ValueError as error:
                raise HandError(f"{srdf}: joint '{joint.get('name')}' has value=\"{joint.get('value')}\"; expected one number"
                                ) from error
    ET.indent(root)
    return f'<?xml version="1.0"?>\n{ET.tostring(root, encoding="unicode")}\n'


def mirror(root: ET.Element) -> None:
    """Turn a hand, in place, into its mirror image at the plane y = 0 of its root link: a right hand into a left one."""
    # Every link's frame is mirrored alike, so equal joint values give mirrored poses. Meshes get a negative scale along y,
    # which MuJoCo and trimesh take as a mirror image with its faces outwards; no mesh is written.
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
    """Make a hand larger or smaller by a factor, in place and at the same densities. Efforts stay."""
    for tag, attributes in POWERS.items():
        for element in root.iter(tag):
            for name, power in attributes.items():
                _change(element, name, (factor**power,) * 3)
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
