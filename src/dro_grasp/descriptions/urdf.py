"""Prepare a URDF in memory for MuJoCo: check links and joints, find meshes, name the root link. No file is changed.

The result is an XML string that MuJoCo reads, with notes on every finding.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from dro_grasp.descriptions.bounds import DEEPEST
from dro_grasp.descriptions.compiling import LEAST_INERTIA, LEAST_MASS
from dro_grasp.descriptions.notes import Note
from dro_grasp.descriptions.urdf_meshes import resolve_meshes
from dro_grasp.errors import HandError

MOVING = {"revolute", "continuous", "prismatic"}
"""URDF joint types with one degree of freedom."""
RENAMED_WORLD = "world_link"
"""Name of a link that its file calls `world`, which is MuJoCo's name for the ground."""


@dataclass(frozen=True)
class PreparedUrdf:
    """A URDF ready for MuJoCo."""

    xml: str
    """The description as MuJoCo reads it."""
    notes: tuple[Note, ...]
    """Findings and repairs."""
    mesh_files: tuple[Path, ...]
    """Every mesh file in use."""
    converted: dict[str, Path]
    """Meshes in formats that MuJoCo cannot read (GLB, DAE, ...), by the file names that stand in for them."""


def prepare_urdf(root: ET.Element, path: Path) -> PreparedUrdf:
    """Check the link tree, resolve meshes and set MuJoCo's options.

    Raises:
        HandError: A name is used twice, a number is not one, no joint moves, links form a cycle or several trees, or no mesh
            is found.
    """
    notes: list[Note] = []
    _check_names(root, path)
    _settle_joints(root, path, notes)
    _drop_empty_shapes(root, path, notes)
    base = _check_links(root, path)
    if base == "world":
        _rename_link(root, "world", RENAMED_WORLD)
        notes.append(Note("info", "world", f"is MuJoCo's name for the ground; this link is called '{RENAMED_WORLD}' here "
                          "and in exported files"))
    _check_mimic(root, path, notes)
    files, converted = resolve_meshes(root, path, notes)
    extension = root.find("mujoco")
    extension = ET.SubElement(root, "mujoco") if extension is None else extension
    compiler = extension.find("compiler")
    compiler = ET.SubElement(extension, "compiler") if compiler is None else compiler
    for stale in ("meshdir", "assetdir", "texturedir"):
        compiler.attrib.pop(stale, None)
    compiler.attrib.update(discardvisual="false", fusestatic="false", balanceinertia="true", boundmass=str(LEAST_MASS),
                           boundinertia=str(LEAST_INERTIA), strippath="false")
    return PreparedUrdf(ET.tostring(root, encoding="unicode"), tuple(notes), tuple(files), converted)


def _check_names(root: ET.Element, path: Path) -> None:
    for kind in ("link", "joint"):
        names = [element.get("name", "") for element in root.findall(kind)]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise HandError(f"{path}: two {kind}s are called '{twice}'; expected a name of its own for each, rename one")


def _settle_joints(root: ET.Element, path: Path, notes: list[Note]) -> None:
    """Make every joint fixed, or movable about one axis within sensible limits."""
    for joint in root.findall("joint"):
        name, kind = joint.get("name", ""), joint.get("type")
        if kind == "floating":
            joint.set("type", "fixed")
            notes.append(Note("info", name, "is a floating joint and is taken as fixed: the wrist is free anyway"))
        elif kind not in MOVING | {"fixed"}:
            raise HandError(f"{path}: joint '{name}' has the type '{kind}'; expected one of "
                            f"{', '.join(sorted(MOVING))}, fixed, floating")
        elif kind != "fixed":
            _check_axis(joint, path)
            if kind != "continuous":
                _check_limits(joint, path, notes)


def _check_axis(joint: ET.Element, path: Path) -> None:
    element = joint.find("axis")
    if element is None:
        return
    axis = _numbers(element, "xyz", path, _called(joint))
    if len(axis) != 3 or math.hypot(*axis) < 1e-6:
        raise HandError(f"{path}: joint '{joint.get('name')}' has the axis '{element.get('xyz')}'; expected a direction "
                        "of three numbers, not all zero")


def _check_limits(joint: ET.Element, path: Path, notes: list[Note]) -> None:
    """Refuse limits that no joint value satisfies. A limit left out is zero; a joint without range is fixed."""
    element = joint.find("limit")
    if element is None or not {"lower", "upper"} & element.attrib.keys():
        return
    for end in ("lower", "upper"):
        element.attrib.setdefault(end, "0")
    lower, upper = (_numbers(element, end, path, _called(joint))[0] for end in ("lower", "upper"))
    if lower > upper:
        raise HandError(f"{path}: joint '{joint.get('name')}' has the lower limit {lower:g} above its upper limit "
                        f"{upper:g}; swap them")
    if lower == upper != 0:
        raise HandError(f"{path}: joint '{joint.get('name')}' has both limits at {lower:g}, so it cannot move; give it a "
                        "range, or make it fixed at that value")
    if lower == upper and joint.find("mimic") is None:
        joint.set("type", "fixed")
        notes.append(Note("warning", joint.get("name", ""), "has both limits at zero and is taken as fixed"))


def _drop_empty_shapes(root: ET.Element, path: Path, notes: list[Note]) -> None:
    """Remove boxes, spheres and cylinders without extent, which MuJoCo refuses."""
    for link in root.findall("link"):
        for element in [*link.findall("visual"), *link.findall("collision")]:
            shape = element.find("geometry/*")
            sizes = [] if shape is None else [
                x for name in ("size", "radius", "length") if name in shape.attrib
                for x in _numbers(shape, name, path, _called(link))
            ]
            if shape is not None and sizes and min(sizes) <= 0:
                link.remove(element)
                notes.append(Note("warning", link.get("name", ""), f"{element.tag} {shape.tag} of size "
                                  f"{' '.join(f'{x:g}' for x in sizes)} has no volume and is left out"))


def _called(element: ET.Element) -> str:
    return f"{element.tag} '{element.get('name')}'"


def _numbers(element: ET.Element, attribute: str, path: Path, owner: str) -> list[float]:
    try:
        values = [float(x) for x in element.get(attribute, "").split()]
    except ValueError:
        values = []
    if not values or not all(math.isfinite(x) for x in values):
        raise HandError(f"{path}: {owner} has {attribute}=\"{element.get(attribute)}\" in <{element.tag}>; expected "
                        "finite numbers")
    return values


def _check_links(root: ET.Element, path: Path) -> str:
    """The root link's name, once the links form one tree."""
    links = [link.get("name", "") for link in root.findall("link")]
    joints = root.findall("joint")
    moving = [j for j in joints if j.get("type") in MOVING]
    if not links:
        raise HandError(f"{path} has no <link>; expected a robot hand description. Expand a xacro file first: xacro {path} > "
                        "hand.urdf")
    if not moving:
        raise HandError(f"{path} has no moving joint ({len(joints)} fixed); a hand needs at least one revolute or "
                        "prismatic joint")
    parent: dict[str, str] = {}
    for joint in joints:
        above, below = (_link_of(joint, end, links, path) for end in ("parent", "child"))
        if below in parent:
            raise HandError(f"{path}: link '{below}' has two parents, '{parent[below]}' and '{above}'; a hand must be "
                            "a tree, remove one of the joints")
        parent[below] = above
    for link in links:
        seen = [link]
        while seen[-1] in parent:
            seen.append(parent[seen[-1]])
            if len(links) >= len(seen) > DEEPEST:
                raise HandError(f"{path} has more than {DEEPEST} links one below the other; expected a robot hand")
            if len(seen) > len(links):
                cycle = " -> ".join(seen[: seen.index(seen[-1]) + 2][:6])
                raise HandError(f"{path}: the links form a cycle ({cycle} ...); a hand must be a tree with one root")
    roots = [link for link in links if link not in parent]
    if len(roots) > 1:
        raise HandError(f"{path} has {len(roots)} root links ({', '.join(roots[:4])}); connect them with fixed joints "
                        "or remove the unused ones")
    return roots[0]


def _link_of(joint: ET.Element, end: str, links: Iterable[str], path: Path) -> str:
    element = joint.find(end)
    name = "" if element is None else element.get("link", "")
    if name not in links:
        raise HandError(f"{path}: joint '{joint.get('name')}' names the {end} link '{name}', which does not exist")
    return name


def _rename_link(root: ET.Element, old: str, new: str) -> None:
    """Rename a link: MuJoCo reserves the name `world`."""
    for link in root.findall("link"):
        if link.get("name") == old:
            link.set("name", new)
    for joint in root.findall("joint"):
        for end in ("parent", "child"):
            element = joint.find(end)
            if element is not None and element.get("link") == old:
                element.set("link", new)


def _check_mimic(root: ET.Element, path: Path, notes: list[Note]) -> None:
    """Drop mimic tags of joints that do not move; refuse cycles of followers."""
    joints = {j.get("name", ""): j for j in root.findall("joint")}
    leader = {name: j.find("mimic").get("joint", "") for name, j in joints.items() if j.find("mimic") is not None}  # type: ignore[union-attr]
    for name, target in leader.items():
        chain = [name]
        while chain[-1] in leader:
            chain.append(leader[chain[-1]])
            if chain[-1] in chain[:-1]:
                raise HandError(f"{path}: mimic joints follow each other in a cycle ({' -> '.join(chain)}); one of "
                                "them must be free")
        kind = joints[target].get("type") if target in joints else "missing"
        if kind not in MOVING:
            notes.append(Note("warning", name, f"mimics joint '{target}', which is {kind}; the joint is taken as free"))
            joints[name].remove(joints[name].find("mimic"))  # type: ignore[arg-type]
