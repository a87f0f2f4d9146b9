"""Take a part of a file that holds a whole robot: the hand, by the link at which it begins, or the arm that carries it.

All raise HandError if there is no such link.
"""

from __future__ import annotations

import difflib
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path

import mujoco

from dro_grasp.errors import HandError
from dro_grasp.files import given_path
from dro_grasp.hands.description.compiling import mujoco_speaks_to

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
    """Keep, in place, a link of a URDF and what hangs on it."""
    ends = _ends(root)
    kept = _below(ends, link)
    _require(link, [element.get("name", "") for element in root.findall("link")], path)
    for joint, (above, below) in ends.items():
        if above not in kept or below == link:
            root.remove(joint)
    for element in root.findall("link"):
        if element.get("name", "") not in kept:
            root.remove(element)


def arm_in_urdf(root: ET.Element, link: str, path: Path) -> None:
    """Keep, in place, all of a URDF but a hand; of the link at which it begins, a frame. Only joints that move it move."""
    _require(link, [element.get("name", "") for element in root.findall("link")], path)
    ends = _ends(root)
    hand, carriers = _below(ends, link), {link}
    while grown := {above for above, below in ends.values() if below in carriers} - carriers:
        carriers |= grown
    for joint, (above, below) in ends.items():
        if above in hand:
            root.remove(joint)
        elif below not in carriers:
            joint.set("type", "fixed")
            for mimic in joint.findall("mimic"):
                joint.remove(mimic)
    for element in root.findall("link"):
        if element.get("name") == link:
            element[:] = [child for child in element if child.tag not in {"visual", "collision", "inertial"}]
        elif element.get("name") in hand:
            root.remove(element)


def arm_in_mjcf(spec: mujoco.MjSpec, link: str, path: Path) -> None:
    """The same of an MJCF, in place; its keyframes are lost."""
    _require(link, [body.name for body in list(spec.bodies)[1:]], path)
    hand = spec.body(link)
    for item in [*hand.bodies, *hand.geoms, *spec.keys]:
        spec.delete(item)
    hand.explicitinertial, carriers, above = False, {link}, hand.parent
    while above is not None and above.name != "world":
        carriers.add(above.name)
        above = above.parent
    for joint in list(spec.joints):
        if joint.parent.name not in carriers:
            spec.delete(joint)


def part_of_mjcf(spec: mujoco.MjSpec, link: str, path: Path) -> mujoco.MjSpec:
    """A body of an MJCF and what hangs on it, with the couplings, tendons, actuators and keyframes of its joints."""
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


def _ends(root: ET.Element) -> dict[ET.Element, tuple[str, str]]:
    """Parent and child link of every joint of a URDF."""
    link_of = lambda end: "" if end is None else end.get("link", "")  # noqa: E731
    return {joint: (link_of(joint.find("parent")), link_of(joint.find("child"))) for joint in root.findall("joint")}


def _below(ends: Mapping[ET.Element, tuple[str, str]], link: str) -> set[str]:
    """A link and all links that hang on it."""
    found = {link}
    while grown := {below for above, below in ends.values() if above in found} - found:
        found |= grown
    return found


def _require(link: str, links: Sequence[str], path: Path) -> None:
    if link and link in links:
        return
    near = difflib.get_close_matches(link, links, n=3)
    hint = f"perhaps {' or '.join(near)}" if near else f"it has {', '.join(links[:12])}{', ...' if len(links) > 12 else ''}"
    raise HandError(f"{path} has no link '{link}', at which a hand could begin; {hint}")
