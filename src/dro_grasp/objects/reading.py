"""Meshes and clouds as they are, before any check: from files, and from what a program already holds."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Num, Shaped
from torch import Tensor

from dro_grasp.errors import ObjectError, UngraspableError
from dro_grasp.files import reading
from dro_grasp.geometry.mesh_files import check_bytes, open_mesh, trimesh
from dro_grasp.objects.perception.things import AS_IMAGE

ObjectSource = (str | Path | trimesh.Trimesh | trimesh.PointCloud | trimesh.Scene | tuple[Any, Any] | Num[np.ndarray, "..."]
                | Num[Tensor, "..."])
"""What an object can be loaded from: its name or file, a mesh, a pair (vertices, faces), or points."""
ORIGIN = "the given object"  # What messages call it
MOST_GROWTH = 128  # What LZF can shorten data to [1]. Source: its longest copy, 264 bytes, takes 3
ALONE = 0.1  # Distance of a point from all others, over the extent of these, that puts it elsewhere [1] (ours)
FEW = 16  # Points of which none is called alone (ours)
IMAGES = {".png", ".tif", ".tiff"}  # Files of depth images, beside NPY
NARROWEST = 32  # Width from which an array (h, w) is an image, and no list of points (ours)
CLOUD_SUFFIXES = {".npy", ".pcd"}  # Files that hold a bare cloud


def read_rows(path: Path) -> Float[np.ndarray, "n columns"]:
    """Points of a cloud file, NaN and outliers included, and its normals in three more columns [metres, or the file's unit]."""
    if not path.is_file():
        raise ObjectError(f"no file at {path}; with camera=... give a cloud file (PLY, NPY, PCD), because named objects "
                          "are meshes, not camera clouds")
    geometry = read_geometry(path)
    if not isinstance(geometry, np.ndarray):
        raise ObjectError(f"{path} is a mesh, not a camera cloud; leave out camera=..., or give a cloud (PLY, NPY, PCD)")
    refuse_image(geometry, str(path))
    rows = in_rows(geometry)
    points = coordinates(rows, str(path))
    return np.column_stack([points, rows[:, 3:]]) if rows.shape[1] == 6 else points


def coordinates(cloud: Shaped[np.ndarray, "..."], origin: str) -> Float[np.ndarray, "n 3"]:
    """The points of a cloud, NaN included, without normals or colours; an ObjectError if they are none."""
    cloud = in_rows(cloud)
    if cloud.ndim != 2 or cloud.shape[1] < 3:
        raise ObjectError(f"{origin} holds an array of shape {cloud.shape}; expected (n, 3) points")
    return np.asarray(cloud[:, :3], np.float64)


def in_rows(cloud: Shaped[np.ndarray, "..."]) -> Shaped[np.ndarray, "..."]:
    """An organised cloud, one point a pixel (h, w, 3 or 6), as rows of points; other arrays as they are."""
    return cloud.reshape(-1, cloud.shape[2]) if cloud.ndim == 3 and cloud.shape[2] in (3, 6) else cloud


def is_image(array: Shaped[np.ndarray, "..."]) -> bool:
    """Whether an array is an image of one channel, and no list of points."""
    image = one_channel(array)
    return image.ndim == 2 and image.shape[1] >= NARROWEST


def one_channel(image: Shaped[np.ndarray, "..."]) -> Shaped[np.ndarray, "..."]:
    """An image of one channel (h, w, 1) as rows and columns (h, w); other arrays as they are."""
    return image[..., 0] if image.ndim == 3 and image.shape[2] == 1 else image


def refuse_image(array: Shaped[np.ndarray, "..."], origin: str) -> None:
    """Refuse an image where points are needed, by an ObjectError."""
    if is_image(array):
        if len(array) == 3:
            raise ObjectError(f"{origin} holds an array of shape {array.shape}; expected (n, 3) points: transpose it")
        raise UngraspableError(f"{origin} holds an array of shape {array.shape}; expected (n, 3) points", AS_IMAGE)


def returned(points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Which points of a cloud are where something was seen: NaN, infinity and (0, 0, 0) stand for pixels without a depth.

    One point at the origin may be the object's; it is none if it is alone there, far from all others.
    """
    finite = np.asarray(np.isfinite(points).all(1))
    zero = np.asarray((points == 0).all(1))
    others = points[finite & ~zero]
    if zero.sum() == 1 and (len(others) < FEW or np.abs(others).max(1).min() <= ALONE * np.ptp(others, axis=0).max()):
        return finite
    return finite & ~zero


def read_geometry(path: Path) -> trimesh.Trimesh | Float[np.ndarray, "..."]:
    """One mesh, scenes merged, or the points of a file without faces; in metres where the file states its unit."""
    if path.suffix.lower() in IMAGES:
        raise UngraspableError(f"{path} is an image, and no mesh or cloud", AS_IMAGE)
    if path.suffix.lower() in CLOUD_SUFFIXES:
        return read_cloud(path)
    # trimesh alone is called here, and its many readers raise whatever they stumble over.
    with reading(path, ObjectError, "a mesh or cloud that trimesh reads (STL, OBJ, PLY, GLB, OFF, ...), NPY or PCD", Exception):
        geometry = in_metres(open_mesh(path, process=False))
        if isinstance(geometry, trimesh.PointCloud):
            return _with_normals(geometry)
    if not isinstance(geometry, trimesh.Trimesh):
        raise ObjectError(f"{path} holds a {type(geometry).__name__}, which has no faces; give a triangle mesh, or a "
                          "point cloud as PLY, NPY or PCD")
    return geometry


def _with_normals(cloud: trimesh.PointCloud) -> Float[np.ndarray, "n k"]:
    """The points of a cloud, and the normals that a PLY file has of them, which trimesh keeps aside."""
    points = np.asarray(cloud.vertices, np.float64)
    raw = cloud.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    names = ("nx", "ny", "nz")
    columns = raw if isinstance(raw, dict) else getattr(getattr(raw, "dtype", None), "names", None) or ()  # binary: an array
    if any(name not in columns or len(raw[name]) != len(points) for name in names):
        return points
    return np.column_stack([points, *(np.asarray(raw[name], np.float64).reshape(len(points)) for name in names)])


def in_metres(given: Any) -> Any:
    """One mesh or cloud, scenes merged, in metres where a unit is stated; what was given stays as it is."""
    try:
        unit = trimesh.units.unit_conversion(given.units, "meters") if given.units else 1.0
    except (KeyError, ValueError) as error:
        raise ObjectError(f"its unit '{given.units}' is unknown; state 'meters' or 'millimeters' (units=...), or None and a "
                          "scale") from error
    geometry = merge_scene(given) if isinstance(given, trimesh.Scene) else given
    return geometry if unit == 1.0 else geometry.copy().apply_scale(unit)


def merge_scene(scene: trimesh.Scene) -> trimesh.Trimesh | trimesh.PointCloud:
    """All meshes of a scene in its frame, or its point clouds if it has no mesh."""
    mesh = scene.to_mesh()
    clouds = [part.vertices for part in scene.dump() if isinstance(part, trimesh.PointCloud)]
    return trimesh.PointCloud(np.concatenate(clouds)) if clouds and len(mesh.faces) == 0 else mesh


def geometry_in_memory(source: Any) -> trimesh.Trimesh | Float[np.ndarray, "..."]:
    """One mesh, scenes merged, or points, in metres where a unit is stated. Other things are an ObjectError."""
    if isinstance(source, trimesh.Trimesh | trimesh.PointCloud | trimesh.Scene):
        geometry = in_metres(source)
        return np.asarray(geometry.vertices, np.float64) if isinstance(geometry, trimesh.PointCloud) else geometry
    if isinstance(source, tuple) and len(source) == 2:
        vertices, faces = numbers(source[0]), numbers(source[1])
        for what, array in (("vertices", vertices), ("faces", faces)):
            if array.ndim != 2 or array.shape[1] != 3:
                raise ObjectError(f"the {what} have shape {array.shape}; expected (n, 3)")
        if faces.dtype.kind not in "iu":
            raise ObjectError(f"the faces are numbers of type {faces.dtype}; give the indices of their vertices as integers")
        return trimesh.Trimesh(vertices, faces, process=False)
    if isinstance(source, np.ndarray | Tensor):
        return numbers(source).astype(np.float64)
    raise ObjectError(f"an object cannot be loaded from a {type(source).__name__}; give a name, the path of a mesh or cloud, a "
                      "trimesh mesh, a pair (vertices, faces), or an array of points (n, 3)")


def numbers(values: Any, origin: str = ORIGIN, kinds: str = "iuf") -> Shaped[np.ndarray, "..."]:
    """An array of numbers from an array, a tensor or nested lists, or an ObjectError; `kinds` has NumPy's letters of types."""
    try:
        array = np.asarray(values.detach().cpu() if isinstance(values, Tensor) else values)
    except (TypeError, ValueError) as error:
        raise ObjectError(f"{origin} is no array of numbers ({error}); give one whose rows have equal lengths") from error
    if array.dtype.kind not in kinds:
        raise ObjectError(f"{origin} holds {array.dtype} instead of numbers; give arrays of floats, and of integers for faces")
    return array


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
            if mapped.dtype.kind not in "biuf":
                raise ValueError(f"it holds {mapped.dtype} instead of numbers")
            return np.array(mapped, np.float64)
    with reading(path, ObjectError, "a PCD file with x y z and all its points; it is damaged"):
        check_bytes(path)
        return _read_pcd(path)


def _check_npy(path: Path) -> None:
    """Refuse a header that claims to be longer than the file, by a ValueError, before as much memory is asked for."""
    with path.open("rb") as file:
        version, length = np.lib.format.read_magic(file), file.read(4)
    claimed = int.from_bytes(length[: 2 if version[0] == 1 else 4], "little")
    if claimed > path.stat().st_size:
        raise ValueError(f"its header claims {claimed} bytes")


def _read_pcd(path: Path) -> Float[np.ndarray, "... columns"]:
    """Points, and normals if there are any, in rows and columns if they are an image's. A field may take several (COUNT)."""
    raw = path.read_bytes()
    header, start = _pcd_header(raw, path)
    fields, kind = header["FIELDS"], header["DATA"][0].lower()
    count = int(header["POINTS"][0]) if "POINTS" in header else int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
    names = [*"xyz"]
    if {"normal_x", "normal_y", "normal_z"} <= set(fields):
        names += ["normal_x", "normal_y", "normal_z"]
    widths = [int(c) for c in header.get("COUNT", ["1"] * len(fields))]
    if kind == "ascii":
        columns = [sum(widths[: fields.index(name)]) for name in names]
        table = _ascii_rows(raw[start:], columns, count)
    elif kind in {"binary", "binary_compressed"}:
        letters, sizes = {"F": "f", "I": "i", "U": "u"}, zip(header["TYPE"], header["SIZE"], widths, strict=True)
        try:
            layout = [np.dtype((f"<{letters[t]}{s}", (c,))) for t, s, c in sizes]
        except TypeError as error:  # there is no number of such a size
            raise ValueError(str(error)) from error
        rows = _packed_columns(raw[start:], layout, count) if kind == "binary_compressed" else np.frombuffer(
            raw, np.dtype([(f"{i}", each) for i, each in enumerate(layout)]), count=count, offset=start)
        table = np.stack([rows[f"{fields.index(name)}"][:, 0].astype(np.float64) for name in names], 1)
    else:
        raise ObjectError(f"{path} holds {kind} data; save the cloud as ascii, binary or binary_compressed PCD")
    if len(table) != count:
        raise ObjectError(f"{path} is truncated: its header promises {count} points, it holds {len(table)}")
    height, width = (int(header.get(name, ["1"])[0]) for name in ("HEIGHT", "WIDTH"))
    return table.reshape(height, width, -1) if height > 1 and height * width == count else table


def _ascii_rows(text: bytes, columns: list[int], count: int) -> Float[np.ndarray, "n columns"]:
    """Some columns of a table of numbers in text, at most so many rows of it."""
    if not count or not text.strip():
        return np.zeros((0, len(columns)))
    return np.loadtxt(io.BytesIO(text), usecols=columns, ndmin=2, max_rows=count, comments=None)


def _packed_columns(raw: bytes, layout: list[np.dtype], count: int) -> dict[str, Num[np.ndarray, "n width"]]:
    """Columns by their place, from compressed data of a PCD file: sizes after and before, then field after field."""
    import lzf  # type: ignore  # compiled, without types

    packed, size = struct.unpack_from("<II", raw)
    if size != count * sum(each.itemsize for each in layout):
        raise ValueError(f"{count} points take {count * sum(each.itemsize for each in layout)} bytes, it states {size}")
    if size > MOST_GROWTH * packed or len(raw) < 8 + packed:
        raise ValueError(f"{packed} compressed bytes are promised, {len(raw) - 8} are there, {size} should come of them")
    # What LZF cannot shorten is stored as it is.
    data = raw[8 : 8 + packed] if packed == size else lzf.decompress(raw[8 : 8 + packed], size)
    if data is None or len(data) != size:
        raise ValueError("its compressed data are damaged")
    ends = np.cumsum([count * each.itemsize for each in layout])
    return {f"{i}": np.frombuffer(data, each, count=count, offset=int(end) - count * each.itemsize)
            for i, (each, end) in enumerate(zip(layout, ends, strict=True))}


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
            header[words[0].upper()] = words[1:]
    return header, position
