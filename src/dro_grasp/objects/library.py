"""Objects by name or path: built-in, development assets, or any file."""

from __future__ import annotations

import difflib
import json
import math
import os
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from dro_grasp.errors import ObjectError
from dro_grasp.objects.builtin import BUILTIN, make_builtin
from dro_grasp.objects.loading import load_file, mesh_object
from dro_grasp.objects.shape import ObjectModel

ASSET_PREFIX = "assets/"
MESH_SUFFIXES = {".obj", ".stl", ".ply", ".glb", ".gltf", ".off", ".dae", ".npy", ".pcd", ".3mf"}
"""Files that count as objects in a folder."""


def load_object(name: str | Path, *, scale: float = 1.0) -> ObjectModel:
    """Load an object by name or from a mesh or point cloud file.

    Args:
        name: A built-in name, an asset's name (`contactdb+apple`), or a path; `assets/NAME` forces the asset.
        scale: Multiplies the coordinates of a file.

    Raises:
        ObjectError: No such object, or it cannot be used.
        ObjectError: `scale` is not positive.
    """
    if not (math.isfinite(scale) and scale > 0):
        raise ObjectError(f"scale is {scale}; give a positive number, for example --scale 0.001 for millimetres")
    text = str(name)
    if text in BUILTIN and scale == 1.0:
        return make_builtin(text)
    entry = _assets().get(text.removeprefix(ASSET_PREFIX))
    if entry is not None and scale == 1.0:
        return _load_asset(entry)
    path = Path(text).expanduser()
    if path.is_dir():
        raise ObjectError(f"{path} is a folder; name one of its files, or use a command that takes folders")
    if path.exists() or path.suffix:
        return load_file(path, scale=scale)
    raise ObjectError(_unknown(text))


def object_names() -> dict[str, str]:
    """Names that `load_object` takes, with their split."""
    names = {name: kind.split for name, kind in BUILTIN.items()}
    names.update({name: entry["multidex_split"] or "extra" for name, entry in _assets().items()})
    return names


def resolve_objects(names: list[str]) -> list[str]:
    """Names with folders replaced by the object files in them.

    Raises:
        ObjectError: A folder holds no object.
    """
    found: list[str] = []
    for name in names:
        folder = Path(name).expanduser()
        if name in BUILTIN or not folder.is_dir():
            found.append(name)
            continue
        files = sorted(str(f) for f in folder.iterdir() if f.suffix.lower() in MESH_SUFFIXES)
        if not files:
            raise ObjectError(f"folder {folder} holds no mesh or point cloud ({', '.join(sorted(MESH_SUFFIXES))})")
        found.extend(files)
    return found


def _assets() -> dict[str, dict[str, Any]]:
    root = os.environ.get("DRO_GRASP_ASSETS")
    return _manifest(Path(root) / "objects" / "manifest.json") if root else {}


@cache
def _manifest(path: Path) -> dict[str, dict[str, Any]]:
    if not path.is_file():
        return {}
    return {entry["name"]: {**entry, "folder": path.parent} for entry in json.loads(path.read_text())}


def _load_asset(entry: dict[str, Any]) -> ObjectModel:
    import trimesh

    mesh = trimesh.load_mesh(entry["folder"] / entry["file"], process=False)
    parts = None
    if entry.get("collision"):
        hulls = trimesh.load_mesh(entry["folder"] / entry["collision"]["file"], process=False).split(only_watertight=False)
        parts = tuple((np.asarray(h.vertices), np.asarray(h.faces)) for h in hulls if len(h.vertices) >= 4)
    return mesh_object(entry["name"], mesh, origin=entry["name"], split=entry["multidex_split"], parts=parts)


def _unknown(name: str) -> str:
    known = object_names()
    near = difflib.get_close_matches(name.removeprefix(ASSET_PREFIX), known, n=3)
    hint = f" Perhaps you meant {' or '.join(near)}." if near else ""
    listed = ", ".join(list(BUILTIN)[:12])
    return (f"no object is called '{name}'.{hint} Known: {listed}, ... (`dro-grasp objects` lists all {len(known)}); or give "
            "the path of a mesh or point cloud")
