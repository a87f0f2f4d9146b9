"""Mesh files, read by trimesh within limits: of size, and of what else they may open.

trimesh is imported here for the whole package, without SciPy's optimisers: they take longer to import than trimesh.
"""

from __future__ import annotations

import io
import json
import re
import sys
import zipfile
from collections import Counter
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
OBJ_LINES = (b"v", b"vt", b"vn")
"""Lines of an OBJ file that the indices of a face's corner count, in their order. Source: OBJ's specification."""
FETCH = "fetch the file itself: git lfs pull, in its repository"
"""What to do about a pointer."""


def open_mesh(path: Path, **options: Any) -> trimesh.Geometry:
    """What trimesh reads from a file, without materials and textures; each reader behind it raises its own errors."""
    check_bytes(path)
    kind, data = path.suffix.lower().removeprefix("."), path.read_bytes()
    _refuse_what_is_misread(data, kind)
    if kind == "obj":
        data = _counted_from_the_first(data)
    # From memory: lengths that a header claims then end with the file, instead of asking for as much.
    with io.BytesIO(data) as content:
        try:
            return trimesh.load(content, kind, skip_materials=True, resolver=Beside(path.parent), **options)
        except TypeError as error:
            if kind != "off":
                raise
            raise ValueError("its faces have unequal numbers of corners; export it in triangles") from error


def _refuse_what_is_misread(data: bytes, kind: str) -> None:
    """Refuse a glTF of whose vertices trimesh reads other numbers than the file states, by a ValueError."""
    if kind != "gltf" and not (kind == "glb" and data.startswith(b"glTF")):
        return
    content = json.loads(data if kind == "gltf" else data[20 : 20 + int.from_bytes(data[12:16], "little")])
    if not isinstance(content, dict):
        return
    if found := [name for name in COMPRESSED if name in content.get("extensionsRequired", [])]:
        raise ValueError(f"its meshes are compressed ({found[0]}); export it without compression")
    accessors = content.get("accessors", [])
    used = {index for mesh in content.get("meshes", []) for part in mesh["primitives"]
            for index in (part.get("indices"), part["attributes"].get("POSITION")) if index is not None}
    for accessor in (accessors[index] for index in used if index < len(accessors)):
        if accessor.get("normalized"):
            raise ValueError("its vertices are integers that stand for fractions (KHR_mesh_quantization); export it without "
                             "quantization")
        if "sparse" in accessor:
            raise ValueError("its vertices or faces are stored as sparse differences; export it without sparse accessors")


def _counted_from_the_first(data: bytes) -> bytes:
    """An OBJ file whose faces have no negative indices, which count from the last line so far, not from the file's last."""
    if not re.search(rb"^[ \t]*f[ \t].*-", data, re.MULTILINE):
        return data
    so_far, lines = Counter[bytes](), list[bytes]()
    for line in data.splitlines():
        first, *words = line.split() or [b""]
        so_far[first] += 1
        if first == b"f":
            corners = ([_counted(index, so_far[kind]) for index, kind in zip(word.split(b"/"), OBJ_LINES, strict=False)]
                       for word in words)
            line = b" ".join([first, *(b"/".join(corner) for corner in corners)])
        lines.append(line)
    return b"\n".join(lines)


def _counted(index: bytes, so_far: int) -> bytes:
    """An index from 1, of one that may count from the last: -1 is the last."""
    return b"%d" % (so_far + 1 + int(index)) if index.startswith(b"-") else index


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
