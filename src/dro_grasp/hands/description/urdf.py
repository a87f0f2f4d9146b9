"""Prepare a URDF in memory for MuJoCo: check links and joints, find meshes, name the root link. No file is changed."""

from __future__ import annotations

import copy
import hashlib
import math
import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path
from typing import NoReturn
from urllib.parse import unquote

from dro_grasp.errors import HandError
from dro_grasp.geometry.mesh_files import FETCH, is_pointer
from dro_grasp.hands.description.compiling import LEAST_INERTIA, LEAST_MASS, Note
from dro_grasp.hands.description.inertials import mend_urdf_inertials
from dro_grasp.hands.description.xml_files import DEEPEST

CONTINUOUS = "but is continuous, a type without limits, so they are not used: if it has them, make it revolute"
"""End of the note of a joint whose limits are not used."""
NOT_FETCHED = "is a pointer of Git LFS"  # Why a mesh that is there has no shape
MOVING = {"revolute", "continuous", "prismatic"}  # URDF joint types with one degree of freedom


def prepare_urdf(root: ET.Element, path: Path, notes: list[Note]) -> tuple[str, list[Path], dict[str, Path]]:
    """Check the link tree, resolve meshes, leave out colours, which nothing here draws, and set MuJoCo's options.

    Returns XML for MuJoCo, and files as `resolve_meshes` does. HandError: a name is used twice, a number is not one, no joint
    moves, links form a cycle or several trees, or no mesh is found.
    """
    _check_names(root, path)
    _settle_joints(root, path, notes)
    _drop_empty_shapes(root, path, notes)
    mend_urdf_inertials(root, notes)
    base = _check_links(root, path)
    if base == "world":
        _rename_world(root, path, notes)
    _check_mimic(root, notes)
    files, converted = resolve_meshes(root, path, notes)
    for coloured in root.findall(".//material/.."):
        for material in coloured.findall("material"):
            coloured.remove(material)
    extension = root.find("mujoco")
    extension = ET.SubElement(root, "mujoco") if extension is None else extension
    compiler = extension.find("compiler")
    compiler = ET.SubElement(extension, "compiler") if compiler is None else compiler
    for stale in ("meshdir", "assetdir", "texturedir"):
        compiler.attrib.pop(stale, None)
    compiler.attrib.update(discardvisual="false", fusestatic="false", balanceinertia="true", boundmass=str(LEAST_MASS),
                           boundinertia=str(LEAST_INERTIA), strippath="false")
    ET.indent(root)  # a line tells of which link or joint it is
    return ET.tostring(root, encoding="unicode"), files, converted


def _rename_world(root: ET.Element, path: Path, notes: list[Note]) -> None:
    """Rename, in place, a root link `world`, which is MuJoCo's name for the ground."""
    below = root.findall("joint/parent[@link='world']/..")
    for place, attribute in (("link", "name"), ("joint/parent", "link")):
        for element in root.findall(f"{place}[@{attribute}='world']"):
            element.set(attribute, "world_link")
    told = "is MuJoCo's name for the ground; this link is called 'world_link' here and in exported files"
    if len(below) == 1 and below[0].get("type") == "fixed":  # else the fingers hang on it
        link = below[0].find("child").get("link")  # type: ignore[union-attr]
        told += f", and no robot has such a frame: for poses of link '{link}' give {path.name}#{link}"
    notes.append(Note("info", "world", told))


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
            for element in joint.findall("axis"):
                axis = _numbers(element, "xyz", path, _called(joint))
                if len(axis) != 3 or math.hypot(*axis) < 1e-6:
                    raise HandError(f"{path}: joint '{name}' has the axis '{element.get('xyz')}'; expected a direction of "
                                    "three numbers, not all zero")
            if kind != "continuous":
                _check_limits(joint, path, notes)
            elif (stated := joint.find("limit")) is not None and {"lower", "upper"} <= stated.attrib.keys():
                told = f"states limits of {stated.get('lower')} to {stated.get('upper')}, {CONTINUOUS}"
                notes.append(Note("warning", name, told))


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


def _has_no_range(joint: ET.Element) -> bool:
    """Whether both limits of a joint that is taken as fixed are zero."""
    limit = joint.find("limit")
    return limit is not None and {"lower", "upper"} <= limit.attrib.keys()


def _drop_empty_shapes(root: ET.Element, path: Path, notes: list[Note]) -> None:
    """Remove boxes, spheres and cylinders without extent, which MuJoCo refuses."""
    for link in root.findall("link"):
        for element in [*link.findall("visual"), *link.findall("collision")]:
            for shape in element.findall("geometry/*")[:1]:
                stated = [name for name in ("size", "radius", "length") if name in shape.attrib]
                sizes = [x for name in stated for x in _numbers(shape, name, path, _called(link))]
                if min(sizes, default=1.0) > 0:
                    continue
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
        still = [joint.get("name", "") for joint in joints if _has_no_range(joint)]
        raise HandError(f"{path} has no moving joint ({len(joints)} fixed); a hand needs at least one revolute or prismatic "
                        "joint" + (f". Both limits of {len(still)} joints are zero ({', '.join(still[:3])}"
                                   f"{', ...' if len(still) > 3 else ''}), so they cannot move: state their limits"
                                   if still else ""))
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


def _check_mimic(root: ET.Element, notes: list[Note]) -> None:
    kinds = {joint.get("name"): joint.get("type") for joint in root.findall("joint")}
    for joint in root.findall("joint"):
        for mimic in joint.findall("mimic"):
            kind = kinds.get(target := mimic.get("joint", ""), "missing")
            if kind not in MOVING:
                notes.append(Note("warning", joint.get("name", ""), f"mimics joint '{target}', which is {kind}; the joint is "
                                  "taken as free"))
                joint.remove(mimic)


def resolve_meshes(root: ET.Element, path: Path, notes: list[Note]) -> tuple[list[Path], dict[str, Path]]:
    """Point every mesh to its file, in place; drop shapes whose mesh cannot be found, if any shape is left.

    Returns the mesh files in use, and those in formats that MuJoCo cannot read by the names that stand in for them. HandError:
    no mesh can be found, and there is no other shape.
    """
    files: dict[str, Path] = {}
    missing: dict[str, str] = {}
    for link in root.iter("link"):
        shapes = [*link.findall("visual"), *link.findall("collision")]
        lost = {element: fault for element in shapes if (fault := _resolve_mesh(element, path, files, notes))}
        for element, fault in lost.items():
            name = element.find("geometry/mesh").get("filename", "")  # type: ignore[union-attr]
            missing[name] = fault
            link.remove(element)
            notes.append(Note("warning", link.get("name", ""), f"{element.tag} mesh '{name}' {fault} and is left out"
                              f"{f'; {FETCH}' if fault == NOT_FETCHED else ''}"))
        if any(element.tag == "collision" for element in lost) and link.find("collision") is None:
            _collide_with_visuals(link, notes)
    if missing and not files and root.find("link/*/geometry") is None:
        _refuse_meshes(missing, path)
    converted = {name: file for name, file in files.items() if name != str(file)}
    return list(files.values()), converted


def _refuse_meshes(missing: dict[str, str], path: Path) -> NoReturn:
    """Refuse a hand without any shape, whose meshes are missing for these reasons."""
    first = next(iter(missing))
    if NOT_FETCHED in missing.values():
        raise HandError(f"{path}: none of its {len(missing)} meshes can be read: {list(missing.values()).count(NOT_FETCHED)} "
                        f"{'are pointers' if len(missing) > 1 else 'is a pointer'} of Git LFS (first: '{first}'); {FETCH}")
    looked = ", ".join(str(p) for p in _candidates(first, path.parent)[:4])
    raise HandError(f"{path}: none of its {len(missing)} meshes can be found (first: '{first}'; looked for "
                    f"{looked}); put the meshes beside the URDF or correct the file names")


def _resolve_mesh(element: ET.Element, path: Path, files: dict[str, Path], notes: list[Note]) -> str:
    """Point a shape's mesh to its file, or to a name that stands in for it; what is wrong if there is none, else nothing."""
    mesh = element.find("geometry/mesh")
    if mesh is None:
        return ""
    name = mesh.get("filename", "")
    file = mesh_of(name, path)
    if file is None:
        return "was not found"
    if is_pointer(file):
        return NOT_FETCHED
    if (told := _found_elsewhere(name, file, path.parent)) is not None and told not in notes:
        notes.append(told)
    # By MuJoCo; trimesh converts the others.
    readable = file.suffix.lower() in {".stl", ".obj", ".msh"} and not _is_unusual_stl(file)
    stand_in = str(file) if readable else hashlib.sha256(name.encode()).hexdigest()[:16] + ".obj"
    mesh.set("filename", stand_in)
    files[stand_in] = file
    return ""


def _is_unusual_stl(file: Path) -> bool:
    """Whether a file is an STL that MuJoCo refuses and others read: text, or more than 200,000 faces."""
    if file.suffix.lower() != ".stl":
        return False
    with file.open("rb") as opened:
        head = opened.read(1000)
    whole = file.stat().st_size == 84 + 50 * int.from_bytes(head[80:84], "little")
    return int.from_bytes(head[80:84], "little") > 200_000 if whole else head.lstrip().startswith(b"solid") and b"facet" in head


def _collide_with_visuals(link: ET.Element, notes: list[Note]) -> None:
    visuals = link.findall("visual")
    for visual in visuals:
        shape = copy.deepcopy(visual)
        shape.tag = "collision"
        link.append(shape)
    if visuals:
        notes.append(Note("warning", link.get("name", ""), "collides with its visual shapes instead"))


def _spellings(name: str) -> tuple[bool, tuple[str, ...]]:
    """Whether a mesh's name is a URI, and its path; in URIs, %20 may stand for a space."""
    name = re.sub(r"^(?:file://)?\$\(find ([^)]*)\)", r"package://\1", name)  # what xacro would have replaced
    rest = name.replace("\\", "/").split("://", 1)[-1]
    return "://" in name, (rest, unquote(rest)) if "://" in name else (rest,)


def _candidates(name: str, folder: Path) -> list[Path]:
    """Paths at which a mesh may lie, the most likely first: in its package before any folder, which may be another's."""
    is_uri, spellings = _spellings(name)
    roots = (folder, *list(folder.parents)[:4]) if is_uri else (folder,)
    tails = dict.fromkeys((*spellings, *(spelling.split("/", 1)[-1] for spelling in spellings)))
    return [root / tail for tail in tails for root in roots]


def _found_elsewhere(name: str, file: Path, folder: Path) -> Note | None:
    """What to say of a mesh whose file has another spelling, or lies in a folder that is not the one, or package, it names."""
    found = next((candidate for candidate in _candidates(name, folder) if os.path.isfile(candidate)), None)
    is_uri, spellings = _spellings(name)
    whole = [Path(spelling).parts for spelling in spellings]
    if found is not None and any(found.parts[-len(parts):] == parts for parts in whole):
        return None
    if found is None or not is_uri:
        return Note("warning", name, f"was not found, and {file} is taken for it")
    package, root = whole[-1][0], found.parents[len(whole[-1]) - 2]
    if _is_package(root, package):
        return None
    return Note("warning", package, f"is no folder near, and meshes are taken from {root}, which may be of another package")


def _is_package(folder: Path, name: str) -> bool:
    """Whether a folder says that it is a ROS package of this name."""
    try:
        return f"<name>{name}</name>" in (folder / "package.xml").read_text(errors="replace").replace(" ", "")
    except OSError:
        return False


def mesh_of(name: str, path: Path) -> Path | None:
    """The file of a mesh that a description names, beside it or beside what it is a link to; None if there is none."""
    return find_mesh(name, path.parent) or find_mesh(name, path.resolve().parent)


def find_mesh(name: str, folder: Path) -> Path | None:
    """The file of a mesh name (relative, absolute, `package://` or `file://`); None if there is none.

    Where no file has the very name, one whose name differs in percent signs or in the case of letters is taken.
    """
    if not name:
        return None
    likely = [*_candidates(name, folder), *_candidates(unquote(name), folder)]
    found = next((file for file in likely if os.path.isfile(file)), None)
    found = found or next(filter(None, map(in_any_case, likely)), None)
    return None if found is None else found.resolve()


def in_any_case(file: Path) -> Path | None:
    """A file whose path differs in the case of letters alone; None if there is none."""
    found = Path(file.anchor)
    for part in file.parts[1:] if file.anchor else file.parts:
        if part == ".." or os.path.lexists(found / part):
            found /= part
            continue
        try:
            alike = sorted(name for name in os.listdir(found) if name.casefold() == part.casefold())
        except OSError:
            return None
        if not alike:
            return None
        found /= alike[0]
    return found if os.path.isfile(found) else None
