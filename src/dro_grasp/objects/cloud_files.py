"""Bare point clouds in NPY and PCD files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from dro_grasp.errors import ObjectError
from dro_grasp.files import reading
from dro_grasp.geometry.mesh_files import check_bytes

CLOUD_SUFFIXES = {".npy", ".pcd"}
"""Files that hold a bare cloud."""
PCD_KINDS = {"F": "f", "I": "i", "U": "u"}
"""NumPy's letters for the number types of PCD."""


def read_cloud(path: Path) -> Float[np.ndarray, "..."]:
    """Points of an NPY or PCD file: (n 3), or (n 6) with normals; an NPY file may hold any shape."""
    if path.suffix.lower() == ".npy":
        with reading(path, ObjectError, "a plain NPY array; save it with numpy.save as floats"):
            check_bytes(path)
            _check_npy(path)
            # A mapped file is never larger than it is, whatever its header says.
            try:
                mapped = np.load(path, mmap_mode="r", allow_pickle=False)
            except TypeError as error:  # its header is a dictionary of other things than NumPy wrote
                raise ValueError(str(error)) from error
            if mapped.size > path.stat().st_size:  # entries of no size
                raise ValueError(f"its header promises {mapped.size} numbers")
            return np.array(mapped, np.float64)
    with reading(path, ObjectError, "a PCD file with x y z and all its points; it is damaged"):
        check_bytes(path)
        return _read_pcd(path)


def _check_npy(path: Path) -> None:
    """Refuse a header that claims to be longer than the file, before as much memory is asked for.

    Raises:
        ValueError: It does.
    """
    with path.open("rb") as file:
        version, length = np.lib.format.read_magic(file), file.read(4)
    claimed = int.from_bytes(length[: 2 if version[0] == 1 else 4], "little")
    if claimed > path.stat().st_size:
        raise ValueError(f"its header claims {claimed} bytes")


def _read_pcd(path: Path) -> Float[np.ndarray, "n columns"]:
    """Points, and normals if there are any. A field may take several columns (COUNT)."""
    raw = path.read_bytes()
    header, start = _pcd_header(raw, path)
    fields, count, kind = header["FIELDS"], int(header["POINTS"][0]), header["DATA"][0]
    names = [*"xyz"]
    if {"normal_x", "normal_y", "normal_z"} <= set(fields):
        names += ["normal_x", "normal_y", "normal_z"]
    widths = [int(c) for c in header.get("COUNT", ["1"] * len(fields))]
    if kind == "ascii":
        columns = [sum(widths[: fields.index(name)]) for name in names]
        lines = [line.split() for line in raw[start:].splitlines() if line.strip()][:count]
        table = np.array(lines, dtype=np.float64).reshape(len(lines), -1)[:, columns]
    elif kind == "binary":
        sizes = zip(header["TYPE"], header["SIZE"], widths, strict=True)
        try:
            layout = np.dtype([(f"{i}", f"<{PCD_KINDS[t]}{s}", (c,)) for i, (t, s, c) in enumerate(sizes)])
        except TypeError as error:  # there is no number of such a size
            raise ValueError(str(error)) from error
        rows = np.frombuffer(raw, layout, count=count, offset=start)
        table = np.stack([rows[f"{fields.index(name)}"][:, 0].astype(np.float64) for name in names], 1)
    else:
        raise ObjectError(f"{path} holds {kind} data; save the cloud as ascii or binary PCD")
    if len(table) != count:
        raise ObjectError(f"{path} is truncated: its header promises {count} points, it holds {len(table)}")
    return table


def _pcd_header(raw: bytes, path: Path) -> tuple[dict[str, list[str]], int]:
    """Header entries, and the offset of the data."""
    header: dict[str, list[str]] = {}
    position = 0
    while "DATA" not in header:
        end = raw.find(b"\n", position)
        if end < 0:
            raise ObjectError(f"{path} is no PCD file: its header has no DATA line")
        words = raw[position:end].decode("ascii", "replace").split()
        position = end + 1
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]
    return header, position
