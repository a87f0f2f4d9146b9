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
import trimesh

from dro_grasp.errors import ObjectError
from dro_grasp.files import given_path
from dro_grasp.kinds import checked
from dro_grasp.objects.builtin import BUILTIN, make_builtin
from dro_grasp.objects.convex_parts import Part
from dro_grasp.objects.in_memory import ObjectSource, object_in_memory
from dro_grasp.objects.loading import check_scale, load_file, mesh_object, read_geometry
from dro_grasp.objects.mesh_process import load_processed, processed_folder
from dro_grasp.objects.procedural import NAME as PROCEDURAL, procedural_object
from dro_grasp.objects.shape import ObjectModel

ASSET_PREFIX = "assets/"
"""Prefix of a name that forces the asset."""
GROUP = re.compile(r"(builtin|assets):(\w+)")
"""A group of objects: their source and split."""
SEEDS = re.compile(r"procedural:(\d{1,9})-(\d{1,9})")
"""A group of objects that do not exist: their first and last seed."""
MOST_SEEDS = 100_000
"""Largest such group (ours)."""
MESH_SUFFIXES = {".obj", ".stl", ".ply", ".glb", ".gltf", ".off", ".dae", ".npy", ".pcd", ".3mf"}
"""Suffixes of the files in a folder that count as objects."""


@checked
def load_object(
    source: ObjectSource, *, scale: float = 1.0, name: str | None = None, keep_table: bool = False
) -> ObjectModel:
    """Load an object by name, from a mesh or point cloud file, or from a mesh or points in memory.

    Args:
        source: A built-in name, an asset's name (`contactdb+apple`), `procedural_17` for the object that seed 17 draws, or a
            path; `assets/NAME` forces the asset. A folder of DexGraspBench is one object, with its convex parts. In memory: a
            trimesh mesh, cloud or scene, a pair (vertices, faces), or points (n 3), with normals (n 6).
        scale: Multiplies all coordinates; 0.001 for millimetres.
        name: What to call the object, instead of its own name.
        keep_table: Take every point of a bare cloud for the object's. By default a table in it is found and cut off, said in a
            note, and hands stay above it.

    Raises:
        ObjectError: The object does not exist, it is unusable, or `scale` is not positive.
    """
    check_scale(scale)
    obj = (
        _load(source, scale, keep_table) if isinstance(source, str | Path) else object_in_memory(source, scale, keep_table))
    return obj if name is None else replace(obj, name=name)


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


def object_names() -> dict[str, str]:
    """Names that `load_object` takes, with their split."""
    names = {name: kind.split for name, kind in BUILTIN.items()}
    names.update({name: entry["multidex_split"] or "extra" for name, entry in _assets().items()})
    return names


def resolve_objects(names: list[str]) -> list[str]:
    """Names with folders replaced by the object files in them, and groups by their members.

    Args:
        names: Names, paths, and groups such as `assets:train` and `procedural:0-99`.

    Raises:
        ObjectError: A folder or a group holds no object.
    """
    found: list[str] = []
    for name in names:
        if (group := GROUP.fullmatch(name)) is not None:
            found.extend(_members(group[1], group[2]))
            continue
        if (seeds := SEEDS.fullmatch(name)) is not None:
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
    """Objects of a split, sorted."""
    names = BUILTIN if source == "builtin" else _assets()
    members = sorted(name for name, kind in object_names().items() if name in names and kind == split)
    if not members:
        where = "" if source == "builtin" or _assets() else "; set DRO_GRASP_ASSETS to the assets folder"
        raise ObjectError(f"no object is in '{source}:{split}'{where} (`dro-grasp objects` lists all with their split)")
    return members


def _procedural(first: int, last: int) -> list[str]:
    """Names of the objects of a range of seeds, both ends included."""
    if last < first:
        raise ObjectError(f"no object is in 'procedural:{first}-{last}'; give the smaller seed first")
    if last - first >= MOST_SEEDS:
        raise ObjectError(f"'procedural:{first}-{last}' stands for {last - first + 1:,} objects; give at most {MOST_SEEDS:,}")
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
    folder, collision = entry["folder"], entry.get("collision")
    return mesh_object(
        entry["name"], _read_mesh(folder / entry["file"]), origin=entry["name"], scale=scale,
        split=entry["multidex_split"], parts=_read_parts(folder / collision["file"]) if collision else None,
    )


def _read_mesh(path: Path) -> trimesh.Trimesh:
    if not path.is_file():
        raise ObjectError(f"the assets' manifest names {path}, which does not exist; repair the assets folder")
    mesh = read_geometry(path)[0]
    if isinstance(mesh, np.ndarray):
        raise ObjectError(f"{path} has no faces; repair the assets folder")
    return mesh


def _read_parts(path: Path) -> tuple[Part, ...]:
    """Convex parts of an asset: the bodies of its collision file that have a volume."""
    hulls = _read_mesh(path).split(only_watertight=False)
    return tuple((np.asarray(h.vertices), np.asarray(h.faces)) for h in hulls if len(h.vertices) >= 4)


def _unknown(name: str) -> str:
    known = object_names()
    near = difflib.get_close_matches(name.removeprefix(ASSET_PREFIX), known, n=3)
    hint = f" Perhaps you meant {' or '.join(near)}." if near else ""
    listed = ", ".join(list(BUILTIN)[:12])
    return (f"no object is called '{name}'.{hint} Known: {listed}, ... (`dro-grasp objects` lists all {len(known)}); "
            "or give the path of a mesh or point cloud")
