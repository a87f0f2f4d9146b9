"""Point cloud files: NPY and PCD. PLY is read by trimesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from dro_grasp.errors import ObjectError

CLOUD_SUFFIXES = {".npy", ".pcd"}
"""Files that hold a bare cloud."""
PCD_KINDS = {"F": "f", "I": "i", "U": "u"}
"""NumPy's letters for the number types of PCD."""


def read_cloud(path: Path) -> Float[np.ndarray, "..."]:
    """Points of an NPY or PCD file: (n 3), or (n 6) with normals; an NPY file may hold any shape."""
    try:
        return _read_npy(path) if path.suffix.lower() == ".npy" else _read_pcd(path)
    except OSError as error:
        raise ObjectError(f"{path} cannot be read: {error.strerror or error}") from error


def _read_npy(path: Path) -> Float[np.ndarray, "..."]:
    try:
        return np.asarray(np.load(path, allow_pickle=False), np.float64)
    except (ValueError, TypeError, EOFError) as error:
        raise ObjectError(f"{path} is no plain NPY array ({error}); save it with numpy.save as floats") from error


def _read_pcd(path: Path) -> Float[np.ndarray, "n columns"]:
    """Points, and normals if there are any. A field may take several columns (COUNT)."""
    raw = path.read_bytes()
    header, start = _pcd_header(raw, path)
    try:
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
            layout = np.dtype([(f"{i}", f"<{PCD_KINDS[t]}{s}", (c,)) for i, (t, s, c) in enumerate(sizes)])
            rows = np.frombuffer(raw, layout, count=count, offset=start)
            table = np.stack([rows[f"{fields.index(name)}"][:, 0].astype(np.float64) for name in names], 1)
        else:
            raise ObjectError(f"{path} holds {kind} data; save the cloud as ascii or binary PCD")
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise ObjectError(f"{path} is a damaged PCD file ({error}); expected x y z and all its points") from error
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
