"""Mesh files, read by trimesh within limits: of size, and of what else they may open.

trimesh is imported here for the whole package, without SciPy's optimisers: they take longer to import than trimesh.
"""

from __future__ import annotations

import io
import json
import sys
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import unquote

OPTIMISERS = "scipy.optimize"
"""Module of which trimesh takes `leastsq` as it is imported, for a function that nothing here calls (ours)."""


def leastsq(*args: Any, **options: Any) -> Any:
    """SciPy's own, once somebody calls it."""
    from scipy import optimize

    return optimize.leastsq(*args, **options)


if OPTIMISERS in sys.modules:
    import trimesh
else:

    sys.modules[OPTIMISERS] = ModuleType(OPTIMISERS)
    sys.modules[OPTIMISERS].__dict__["leastsq"] = leastsq
    try:
        import trimesh
    finally:
        del sys.modules[OPTIMISERS]

MAX_BYTES = 200_000_000  # Largest file, unpacked [bytes] (ours); reading takes some ten times as much memory

POINTER = b"version https://git-lfs.github.com/spec/"  # How such files begin. Source: specification of Git LFS, version 1
COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression")
"""Extensions of glTF by which meshes are compressed. Source: glTF's registry of extensions."""
FETCH = "fetch the file itself: git lfs pull, in its repository"
"""What to do about a pointer."""


def open_mesh(path: Path, **options: Any) -> trimesh.Geometry:
    """What trimesh reads from a file, without materials and textures; each reader behind it raises its own errors."""
    check_bytes(path)
    kind, data = path.suffix.lower().removeprefix("."), path.read_bytes()
    _refuse_compressed(data, kind)
    # From memory: lengths that a header claims then end with the file, instead of asking for as much.
    with io.BytesIO(data) as content:
        return trimesh.load(content, kind, skip_materials=True, resolver=Beside(path.parent), **options)


def _refuse_compressed(data: bytes, kind: str) -> None:
    """Refuse a glTF whose meshes are compressed, by a ValueError: trimesh reads one point of each."""
    if kind != "gltf" and not (kind == "glb" and data.startswith(b"glTF")):
        return
    content = json.loads(data if kind == "gltf" else data[20 : 20 + int.from_bytes(data[12:16], "little")])
    required = content.get("extensionsRequired", []) if isinstance(content, dict) else []
    if found := [name for name in COMPRESSED if name in required]:
        raise ValueError(f"its meshes are compressed ({found[0]}); export it without compression")


def is_pointer(path: Path) -> bool:
    """Whether a file is the note that Git LFS leaves in place of one that was not fetched; what cannot be read is none."""
    try:
        with path.open("rb") as file:
            return file.read(len(POINTER)) == POINTER
    except OSError:
        return False


def check_bytes(path: Path) -> None:
    """Refuse a file that is too large, an archive that unpacks to too much, or a pointer of Git LFS, by a ValueError."""
    if is_pointer(path):
        raise ValueError(f"it is a pointer of Git LFS; {FETCH}")
    size = path.stat().st_size
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            size = max(size, sum(entry.file_size for entry in archive.infolist()))
    if size > MAX_BYTES:
        raise ValueError(f"it holds {size / 1e6:.0f} MB, the limit is {MAX_BYTES / 1e6:.0f}: simplify the mesh or thin out "
                         "the cloud")


class Beside(Mapping[str, bytes]):
    """Files that a mesh file names, such as the buffers of a glTF: plain files in its own folder, of limited size."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()

    def __getitem__(self, name: str) -> bytes:
        likely = ((self.folder / each).resolve() for each in (name, unquote(name)))  # names of a glTF are parts of URIs
        file = next((each for each in likely if each.is_file()), self.folder / name)
        if not (file.is_relative_to(self.folder) and file.is_file()):
            raise FileNotFoundError(f"it names '{name}', and there is no such file beside it")
        check_bytes(file)
        return file.read_bytes()

    def __iter__(self) -> Iterator[str]:
        return iter(())

    def __len__(self) -> int:
        return 0
