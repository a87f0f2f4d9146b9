"""Objects by name or path: built-in, development assets, or any file."""

from __future__ import annotations

import difflib
import json
import os
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from dro_grasp.errors import ObjectError
from dro_grasp.files import given_path
from dro_grasp.geometry.mesh_files import trimesh
from dro_grasp.kinds import checked
from dro_grasp.objects.builtin import BUILTIN, make_builtin
from dro_grasp.objects.convex_parts import as_part
from dro_grasp.objects.loading import check_scale, load_file, mesh_object, object_in_memory
from dro_grasp.objects.procedural import PROCEDURAL, procedural_object
from dro_grasp.objects.reading import ObjectSource, read_geometry
from dro_grasp.objects.shape import ObjectModel, with_mass

ASSET_PREFIX = "assets/"  # Prefix of a name that forces the asset
MAX_SEEDS = 100_000  # Largest such group (ours)
MESH_SUFFIXES = {".obj", ".stl", ".ply", ".glb", ".gltf", ".off", ".dae", ".npy", ".pcd", ".3mf"}
"""Suffixes of the files in a folder that count as objects."""
MESH = "mesh/simplified.obj"
"""The mesh of an object that MeshProcess prepared for DexGraspBench, in the object's folder; its largest extent is about 2.
Source: the readme and the example objects of DexGraspBench."""
PARTS = "urdf/meshes"  # Folder of its convex parts
SCALES = (0.06, 0.08, 0.1, 0.12)  # Scales of every object in the official grasps


@checked
def load_object(
    source: ObjectSource, *, scale: float = 1.0, name: str | None = None, keep_table: bool = False, mass: float | None = None
) -> ObjectModel:
    """Load an object by name, from a mesh or point cloud file, or from a mesh or points in memory.

    Args:
        source: A built-in name, an asset's name (`contactdb+apple`), `procedural_17` for the object that seed 17 draws, or a
            path; `assets/NAME` forces the asset. A folder of DexGraspBench is one object, with its convex parts. In memory: a
            trimesh mesh, cloud or scene, a pair (vertices, faces), or points (n 3), with normals (n 6).
        scale: Multiplies all coordinates; 0.001 for millimetres.
        name: What to call the object, instead of its own name.
        keep_table: Keep every point of a bare cloud. By default a table in it is found and cut off, with a note, and hands
            stay above it.
        mass: Mass, in place of density and volume [kg].

    Raises:
        ObjectError: The object does not exist, it is unusable, or `scale` or `mass` is not positive.
    """
    check_scale(scale)
    obj = _load(source, scale, keep_table) if isinstance(source, str | Path) else object_in_memory(source, scale, keep_table)
    obj = obj if obj.scale == scale else replace(obj, scale=scale)
    obj = obj if name is None else replace(obj, name=name)
    return obj if mass is None else with_mass(obj, mass)


def _load(name: str | Path, scale: float, keep_table: bool) -> ObjectModel:
    text = str(name)
    if text in BUILTIN:
        return make_builtin(text, scale=scale)
    if (seed := PROCEDURAL.fullmatch(text)) is not None:
        return procedural_object(int(seed[1]), scale=scale)
    entry = _assets().get(text.removeprefix(ASSET_PREFIX))
    if entry is not None:
        return _load_asset(entry, scale)
    path = given_path(text)
    if (folder := processed_folder(path)) is not None:
        return load_processed(folder, scale)
    if path.is_dir():
        raise ObjectError(f"{path} is a folder; name one of its files, or use a command that takes folders")
    if path.exists() or path.suffix:
        return replace(load_file(path, scale=scale, keep_table=keep_table), file=str(path.resolve()), scale=scale)
    raise ObjectError(_unknown(text))


def locate_object(name: str) -> tuple[Path, str]:
    """The file or folder of an object, or its bare name where it has none of its own; and what `load_object` calls it."""
    path, bare = given_path(name), name.removeprefix(ASSET_PREFIX)
    if name in BUILTIN or PROCEDURAL.fullmatch(name):
        return path, name
    entry = _assets().get(bare)
    if entry is not None:
        return entry["folder"] / entry["file"], bare
    return path, path.name if path.is_dir() else path.stem


def is_object_name(text: str) -> bool:
    """Whether `load_object` takes a text for the name of an object, even where there is a file of that name."""
    return text in BUILTIN or bool(PROCEDURAL.fullmatch(text)) or text.removeprefix(ASSET_PREFIX) in _assets()


def object_names() -> dict[str, str]:
    """Names that `load_object` takes, with their split."""
    assets = {name: entry["multidex_split"] or "extra" for name, entry in _assets().items()}
    return {name: kind.split for name, kind in BUILTIN.items()} | assets


def resolve_objects(names: list[str]) -> list[str]:
    """Names and paths with folders replaced by the object files in them, and groups by their members.

    Groups are such as `assets:train` and `procedural:0-99`. A folder or a group that holds no object is an ObjectError.
    """
    found: list[str] = []
    for name in names:
        if (group := re.fullmatch(r"(builtin|assets):(\w+)", name)) is not None:
            found.extend(_members(group[1], group[2]))
            continue
        if (seeds := re.fullmatch(r"procedural:(\d{1,9})-(\d{1,9})", name)) is not None:
            found.extend(_procedural(int(seeds[1]), int(seeds[2])))
            continue
        folder = given_path(name)
        if name in BUILTIN or not folder.is_dir() or processed_folder(folder) is not None:
            found.append(name)
            continue
        files = sorted(str(f) for f in folder.iterdir() if f.suffix.lower() in MESH_SUFFIXES)
        if not files:
            raise ObjectError(f"folder {folder} holds no mesh or point cloud ({', '.join(sorted(MESH_SUFFIXES))})")
        found.extend(files)
    return found


def _members(source: str, split: str) -> list[str]:
    names = BUILTIN if source == "builtin" else _assets()
    members = sorted(name for name, kind in object_names().items() if name in names and kind == split)
    if not members:
        where = "" if source == "builtin" or _assets() else "; set DRO_GRASP_ASSETS to the assets folder"
        raise ObjectError(f"no object is in '{source}:{split}'{where} (`dro-grasp objects` lists all with their split)")
    return members


def _procedural(first: int, last: int) -> list[str]:
    if last < first:
        raise ObjectError(f"no object is in 'procedural:{first}-{last}'; give the smaller seed first")
    if last - first >= MAX_SEEDS:
        raise ObjectError(f"'procedural:{first}-{last}' stands for {last - first + 1:,} objects; give at most {MAX_SEEDS:,}")
    return [f"procedural_{seed}" for seed in range(first, last + 1)]


def _assets() -> dict[str, dict[str, Any]]:
    root = os.environ.get("DRO_GRASP_ASSETS")
    return _manifest(given_path(root) / "objects" / "manifest.json") if root else {}


@cache
def _manifest(path: Path) -> dict[str, dict[str, Any]]:
    if not path.is_file():
        return {}
    try:
        return {entry["name"]: {**entry, "folder": path.parent} for entry in json.loads(path.read_text())}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ObjectError(f"{path} is no list of objects ({error}); unset DRO_GRASP_ASSETS or repair it") from error


def _load_asset(entry: dict[str, Any], scale: float) -> ObjectModel:
    folder, collision, parts = entry["folder"], entry.get("collision"), None
    if collision:
        bodies = _read_mesh(folder / collision["file"]).split(only_watertight=False)
        parts = tuple(map(as_part, (body for body in bodies if len(body.vertices) >= 4)))  # fewer have no volume
    return mesh_object(entry["name"], _read_mesh(folder / entry["file"]), origin=entry["name"], scale=scale,
                       split=entry["multidex_split"], parts=parts)


def _read_mesh(path: Path) -> trimesh.Trimesh:
    if not path.is_file():
        raise ObjectError(f"the assets' manifest names {path}, which does not exist; repair the assets folder")
    mesh = read_geometry(path)
    if isinstance(mesh, np.ndarray):
        raise ObjectError(f"{path} has no faces; prepare the object, or the assets folder, again")
    return mesh


def processed_folder(path: Path) -> Path | None:
    """The folder of an object of DexGraspBench if the path is it, or the mesh in it; else None."""
    for folder in (path, path.parent.parent):
        if (folder / PARTS).is_dir() and (folder / MESH).is_file() and path in {folder, folder / MESH}:
            return folder
    return None


def processed_objects(folder: Path | str) -> list[Path]:
    """Folders of all objects of DexGraspBench at any depth of a folder, such as a clone of it or its archive, sorted."""
    folder = given_path(folder)
    found = sorted(path.parent.parent for path in folder.rglob(MESH) if processed_folder(path))
    if not found:
        raise ObjectError(f"{folder} holds no object of DexGraspBench (a folder with {MESH} and {PARTS}); name the folder of "
                          "its clone, or of the unpacked archive of objects")
    return found


def load_processed(folder: Path, scale: float) -> ObjectModel:
    """The object of a folder, with the convex parts that the benchmark collides; its name is the folder's and the scale."""
    parts = tuple(as_part(_read_mesh(file)) for file in sorted((folder / PARTS).glob("*.obj")))
    obj = mesh_object(
        f"{folder.name}@{scale:g}", _read_mesh(folder / MESH), origin=str(folder), scale=scale, parts=parts or None)
    return replace(obj, file=str((folder / MESH).resolve()), scale=scale)


def _unknown(name: str) -> str:
    known = object_names()
    near = difflib.get_close_matches(name.removeprefix(ASSET_PREFIX), known, n=3)
    hint = f" Perhaps you meant {' or '.join(near)}." if near else ""
    listed = ", ".join(list(BUILTIN)[:12])
    return (f"no object is called '{name}'.{hint} Known: {listed}, ... (`dro-grasp objects` lists all {len(known)}); "
            "or give the path of a mesh or point cloud")
