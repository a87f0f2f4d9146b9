"""Take a part of a description: the hand of a file that holds a whole robot, by the link at which it begins."""

from __future__ import annotations

import difflib
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import mujoco

from dro_grasp.descriptions.compiling import mujoco_speaks_to
from dro_grasp.errors import HandError
from dro_grasp.files import given_path

MARK = "#"
"""What stands between a file and the link at which a hand begins in it."""


def named(file: object, link: str | None) -> str:
    """A file, or the part of it that begins at a link, as users write it."""
    return str(file) if link is None else f"{file}{MARK}{link}"


def split_part(name: str) -> tuple[str, str | None]:
    """What a user wrote of a hand, and the link at which it begins, if that was written behind it."""
    if MARK not in name or given_path(name).exists():
        return name, None
    file, _, link = name.rpartition(MARK)
    return file, link


def part_of_urdf(root: ET.Element, link: str, path: Path) -> None:
    """Keep, in place, a link of a URDF and what hangs on it.

    Raises:
        HandError: There is no such link.
    """
    links = {element.get("name", ""): element for element in root.findall("link")}
    _require(link, list(links), path)
    ends, kept = {joint: (_end(joint, "parent"), _end(joint, "child")) for joint in root.findall("joint")}, {link}
    while grown := {below for above, below in ends.values() if above in kept} - kept:
        kept |= grown
    for joint, (above, below) in ends.items():
        if above not in kept or below == link:
            root.remove(joint)
    for name, element in links.items():
        if name not in kept:
            root.remove(element)


def part_of_mjcf(spec: mujoco.MjSpec, link: str, path: Path) -> mujoco.MjSpec:
    """A body of an MJCF and what hangs on it, with the couplings, tendons, actuators and keyframes of its joints.

    Raises:
        HandError: There is no such body, or MuJoCo cannot take it out.
    """
    _require(link, [body.name for body in list(spec.bodies)[1:]], path)
    part = mujoco.MjSpec()
    part.compiler.degree = spec.compiler.degree
    with mujoco_speaks_to([], path):  # of its options, all of which the protocol sets
        part.worldbody.add_frame().attach_body(spec.body(link), "", "")
    shown = {geom.meshname for geom in part.geoms}
    for mesh in list(part.meshes):
        if mesh.name not in shown:
            part.delete(mesh)
    return part


def _end(joint: ET.Element, which: str) -> str:
    element = joint.find(which)
    return "" if element is None else element.get("link", "")


def _require(link: str, links: Sequence[str], path: Path) -> None:
    if link in links:
        return
    near = difflib.get_close_matches(link, links, n=3)
    hint = f"perhaps {' or '.join(near)}" if near else f"it has {', '.join(links[:12])}{', ...' if len(links) > 12 else ''}"
    raise HandError(f"{path} has no link '{link}', at which a hand could begin; {hint}")
