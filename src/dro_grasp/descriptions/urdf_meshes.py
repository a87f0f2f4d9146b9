"""The meshes that a URDF names: find them, and replace those that are missing or in formats that MuJoCo cannot read."""

from __future__ import annotations

import copy
import hashlib
import os
import xml.etree.ElementTree as ET
from pathlib import Path
from urllib.parse import unquote

from dro_grasp.descriptions.notes import Note
from dro_grasp.errors import HandError
from dro_grasp.files import reading
from dro_grasp.geometry.mesh_files import open_mesh

READABLE_MESHES = {".stl", ".obj", ".msh"}
"""Mesh formats that MuJoCo reads; trimesh converts the others."""


def resolve_meshes(root: ET.Element, path: Path, notes: list[Note]) -> tuple[list[Path], dict[str, Path]]:
    """Point every mesh to its file, in place; drop shapes whose mesh cannot be found, if any shape is left.

    Returns:
        The mesh files in use, and those in formats that MuJoCo cannot read by the names that stand in for them.

    Raises:
        HandError: No mesh can be found, and there is no other shape.
    """
    files: dict[str, Path] = {}
    missing: list[str] = []
    for link in root.iter("link"):
        lost = [element for element in [*link.findall("visual"), *link.findall("collision")]
                if not _resolve_mesh(element, path.parent, files)]
        for element in lost:
            name = element.find("geometry/mesh").get("filename", "")  # type: ignore[union-attr]
            missing.append(name)
            link.remove(element)
            notes.append(Note("warning", link.get("name", ""), f"{element.tag} mesh '{name}' was not found and is left out"))
        if any(element.tag == "collision" for element in lost) and link.find("collision") is None:
            _collide_with_visuals(link, notes)
    if missing and not files and not _has_geometry(root):
        looked = ", ".join(str(p) for p in _candidates(missing[0], path.parent)[:4])
        raise HandError(f"{path}: none of its {len(missing)} meshes can be found (first: '{missing[0]}'; looked for "
                        f"{looked}); put the meshes beside the URDF or correct the file names")
    converted = {name: file for name, file in files.items() if name != str(file)}
    return list(files.values()), converted


def _resolve_mesh(element: ET.Element, folder: Path, files: dict[str, Path]) -> bool:
    """Point a shape's mesh to its file, or to a name that stands in for it; False if there is no such file."""
    mesh = element.find("geometry/mesh")
    if mesh is None:
        return True
    name = mesh.get("filename", "")
    file = find_mesh(name, folder)
    if file is None:
        return False
    stand_in = str(file) if file.suffix.lower() in READABLE_MESHES else _stand_in(name)
    mesh.set("filename", stand_in)
    files[stand_in] = file
    return True


def as_obj(file: Path) -> bytes:
    """A mesh in any format trimesh reads, as OBJ text."""
    import trimesh

    # trimesh alone is called here, and its many readers raise whatever they stumble over.
    with reading(f"mesh {file}", HandError, "STL, OBJ, GLB, DAE or PLY, whole", Exception):
        loaded = open_mesh(file)
        mesh = loaded.to_mesh() if isinstance(loaded, trimesh.Scene) else loaded
        return trimesh.exchange.obj.export_obj(mesh, include_normals=False, include_texture=False).encode()


def _stand_in(name: str) -> str:
    return hashlib.sha256(name.encode()).hexdigest()[:16] + ".obj"


def _collide_with_visuals(link: ET.Element, notes: list[Note]) -> None:
    """Let a link whose collision meshes are all missing collide with its visual shapes."""
    visuals = link.findall("visual")
    for visual in visuals:
        shape = copy.deepcopy(visual)
        shape.tag = "collision"
        link.append(shape)
    if visuals:
        notes.append(Note("warning", link.get("name", ""), "collides with its visual shapes instead"))


def _has_geometry(root: ET.Element) -> bool:
    return any(link.find(f"{kind}/geometry") is not None for link in root.iter("link") for kind in ("visual", "collision"))


def _candidates(name: str, folder: Path) -> list[Path]:
    """Paths at which a mesh may lie, the most likely first; in URIs, %20 may stand for a space."""
    rest = name.replace("\\", "/").split("://", 1)[-1]
    roots, spellings = ((folder, *list(folder.parents)[:4]), (rest, unquote(rest))) if "://" in name else ((folder,), (rest,))
    tails = dict.fromkeys(tail for spelling in spellings for tail in (spelling, spelling.split("/", 1)[-1]))
    return [root / tail for root in roots for tail in tails]


def find_mesh(name: str, folder: Path) -> Path | None:
    """The file of a mesh name (relative, absolute, `package://` or `file://`); None if there is none."""
    if not name:
        return None
    return next((file.resolve() for file in _candidates(name, folder) if os.path.isfile(file)), None)
