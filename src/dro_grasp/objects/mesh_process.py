"""Objects as MeshProcess prepares them for DexGraspBench: one folder each, with a mesh and its convex parts.

Source: the readme and the example objects of DexGraspBench.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh

from dro_grasp.errors import ObjectError
from dro_grasp.files import given_path
from dro_grasp.objects.convex_parts import Part
from dro_grasp.objects.loading import mesh_object, read_geometry
from dro_grasp.objects.shape import ObjectModel

MESH = "mesh/simplified.obj"
"""The mesh within an object's folder; the largest of its extents is about 2 at scale 1."""
PARTS = "urdf/meshes"
"""Folder of its convex parts."""
SCALES = (0.06, 0.08, 0.1, 0.12)
"""Scales of every object in the official grasps."""


def processed_folder(path: Path) -> Path | None:
    """The folder of such an object if the path is it, or the mesh in it; else None."""
    for folder in (path, path.parent.parent):
        if (folder / PARTS).is_dir() and (folder / MESH).is_file() and path in {folder, folder / MESH}:
            return folder
    return None


def processed_objects(folder: Path | str) -> list[Path]:
    """Folders of all such objects at any depth of a folder, such as a clone of DexGraspBench or its archive, sorted.

    Raises:
        ObjectError: There is none.
    """
    folder = given_path(folder)
    found = sorted(path.parent.parent for path in folder.rglob(MESH) if processed_folder(path))
    if not found:
        raise ObjectError(f"{folder} holds no object of DexGraspBench (a folder with {MESH} and {PARTS}); name the folder of "
                          "its clone, or of the unpacked archive of objects")
    return found


def load_processed(folder: Path, scale: float) -> ObjectModel:
    """The object of a folder, with the convex parts that the benchmark collides; its name is the folder's and the scale.

    Raises:
        ObjectError: A file in the folder is unusable.
    """
    parts = tuple(_part(file) for file in sorted((folder / PARTS).glob("*.obj")))
    obj = mesh_object(f"{folder.name}@{scale:g}", _mesh(folder / MESH), origin=str(folder), scale=scale, parts=parts or None)
    return replace(obj, file=str((folder / MESH).resolve()), scale=scale)


def _mesh(path: Path) -> trimesh.Trimesh:
    mesh = read_geometry(path)[0]
    if isinstance(mesh, np.ndarray):
        raise ObjectError(f"{path} has no faces; prepare the object again")
    return mesh


def _part(path: Path) -> Part:
    mesh = _mesh(path)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)
