"""Variants of a hand: its mirror image, and larger or smaller ones."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path

from dro_grasp.descriptions.mirroring import mirror, scale
from dro_grasp.descriptions.part import part_of_urdf
from dro_grasp.descriptions.urdf_meshes import find_mesh
from dro_grasp.descriptions.xml_files import parse_xml
from dro_grasp.errors import HandError, OptionError
from dro_grasp.files import command
from dro_grasp.hands.library import locate_hand
from dro_grasp.kinds import checked


@checked
def vary_hand(name: str | Path, *, mirrored: bool = False, factor: float = 1.0) -> str:
    """The URDF of a hand's mirror image, of a scaled hand, or of both.

    Meshes stay where they are: the text names them by their absolute paths.

    Args:
        name: A hand's name or file, as for `load_hand`; it must be a URDF.
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
        file = find_mesh(mesh.get("filename", ""), path.parent)
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
