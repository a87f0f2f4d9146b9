"""Preparing a URDF in memory: safe parsing, mesh paths, root link. No file is changed.

The result is an XML string that MuJoCo reads; everything found on the way is reported as notes.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import defusedxml
import defusedxml.ElementTree

from dro_grasp.errors import HandError

READABLE_MESHES = {".stl", ".obj", ".msh"}
"""Mesh formats that MuJoCo reads itself; others go through trimesh."""


@dataclass(frozen=True)
class Note:
    """Something that loading found: what was derived, repaired or is wrong."""

    level: Literal["info", "warning", "error"]
    subject: str
    """The link, joint or file concerned."""
    text: str


@dataclass(frozen=True)
class PreparedUrdf:
    """A URDF ready for MuJoCo."""

    xml: str
    notes: tuple[Note, ...]
    mesh_files: tuple[Path, ...]
    """Every mesh file in use."""
    converted: dict[str, Path]
    """Stand-in file name -> mesh in a format that MuJoCo cannot read (GLB, DAE, ...)."""


def parse_xml(path: Path) -> ET.Element:
    """Parse a description, refusing entity tricks.

    Raises:
        HandError: The file is missing, is not XML, or declares entities.
    """
    if path.is_dir():
        raise HandError(f"{path} is a folder; give the URDF or MJCF file inside it")
    if not path.is_file():
        raise HandError(f"no hand description at {path}; give an existing .urdf or .xml file, or a name that "
                        "`dro-grasp hands` lists")
    try:
        root = defusedxml.ElementTree.parse(path, forbid_dtd=False).getroot()
    except defusedxml.DefusedXmlException as error:
        raise HandError(f"{path} declares XML entities ({type(error).__name__}), which are refused because they can "
                        "exhaust memory or read other files; remove its <!ENTITY ...> lines") from error
    except ET.ParseError as error:
        raise HandError(f"{path} is not valid XML ({error}); expected a URDF (<robot>) or MJCF (<mujoco>) file") from error
    if root is None:
        raise HandError(f"{path} is an empty XML file; expected a URDF (<robot>) or MJCF (<mujoco>) file")
    return root


def prepare_urdf(root: ET.Element, path: Path) -> PreparedUrdf:
    """Check the link tree, resolve meshes and set what MuJoCo needs to know.

    Raises:
        HandError: No moving joint, a cycle, several roots, or no mesh that can be found.
    """
    notes: list[Note] = []
    base = _check_links(root, path)
    if base == "world":
        _rename_link(root, "world", "world_link")
    _check_mimic(root, path, notes)
    files, converted = _resolve_meshes(root, path, notes)
    extension = root.find("mujoco")
    extension = ET.SubElement(root, "mujoco") if extension is None else extension
    compiler = extension.find("compiler")
    compiler = ET.SubElement(extension, "compiler") if compiler is None else compiler
    for stale in ("meshdir", "assetdir", "texturedir"):
        compiler.attrib.pop(stale, None)
    compiler.attrib.update(discardvisual="false", fusestatic="false", balanceinertia="true", boundmass="1e-4",
                           boundinertia="1e-8", strippath="false")
    return PreparedUrdf(ET.tostring(root, encoding="unicode"), tuple(notes), tuple(files), converted)


def _check_links(root: ET.Element, path: Path) -> str:
    """The root link's name; the tree must be a tree."""
    links = [link.get("name", "") for link in root.findall("link")]
    joints = root.findall("joint")
    moving = [j for j in joints if j.get("type") in {"revolute", "continuous", "prismatic"}]
    if not links:
        raise HandError(f"{path} has no <link>; expected a robot hand description")
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
    """MuJoCo keeps the name `world` for itself."""
    for link in root.findall("link"):
        if link.get("name") == old:
            link.set("name", new)
    for joint in root.findall("joint"):
        for end in ("parent", "child"):
            element = joint.find(end)
            if element is not None and element.get("link") == old:
                element.set("link", new)


def _check_mimic(root: ET.Element, path: Path, notes: list[Note]) -> None:
    """Report mimic tags that lead nowhere; refuse cycles of followers."""
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
        if kind not in {"revolute", "continuous", "prismatic"}:
            notes.append(Note("warning", name, f"mimics joint '{target}', which is {kind}; the joint is taken as free"))
            joints[name].remove(joints[name].find("mimic"))  # type: ignore[arg-type]


def _resolve_meshes(root: ET.Element, path: Path, notes: list[Note]) -> tuple[list[Path], dict[str, Path]]:
    """Point every mesh to its file; drop what cannot be found, if something is left."""
    files: list[Path] = []
    converted: dict[str, Path] = {}
    missing: list[str] = []
    for link in root.iter("link"):
        for element in [*link.findall("visual"), *link.findall("collision")]:
            mesh = element.find("geometry/mesh")
            if mesh is None:
                continue
            name = mesh.get("filename", "")
            file = find_mesh(name, path.parent)
            if file is None:
                missing.append(name)
                link.remove(element)
                notes.append(Note("warning", link.get("name", ""), f"{element.tag} mesh '{name}' was not found and is "
                                  "left out"))
                continue
            files.append(file)
            if file.suffix.lower() not in READABLE_MESHES:
                converted[name] = file
                mesh.set("filename", name)
            else:
                mesh.set("filename", str(file))
    if missing and not files and not _has_geometry(root):
        looked = ", ".join(str(p) for p in _mesh_roots(missing[0], path.parent)[:3])
        raise HandError(f"{path}: none of its {len(missing)} meshes can be found (first: '{missing[0]}'; looked below "
                        f"{looked}); put the meshes beside the URDF or correct the file names")
    return files, converted


def _has_geometry(root: ET.Element) -> bool:
    return any(link.find(f"{kind}/geometry") is not None for link in root.iter("link") for kind in ("visual", "collision"))


def _mesh_roots(name: str, folder: Path) -> tuple[Path, ...]:
    return (folder, *list(folder.parents)[:4]) if "://" in name else (folder,)


def find_mesh(name: str, folder: Path) -> Path | None:
    """The file behind a mesh name: relative, absolute, `package://` or `file://`; None when there is none."""
    rest = name.split("://", 1)[-1]
    for root in _mesh_roots(name, folder):
        for tail in (rest, rest.split("/", 1)[-1]):
            candidate = root / tail
            if candidate.is_file():
                return candidate.resolve()
    return None
