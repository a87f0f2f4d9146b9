"""From a file to an ObjectModel: reading, checks, safe repairs, all of it reported."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dro_grasp.errors import ObjectError
from dro_grasp.objects.shape import CLOUD_POINTS, ObjectModel, Part, content_hash

if TYPE_CHECKING:
    import trimesh

LARGEST, SMALLEST = 1.0, 0.005
"""Extents between which an object is believed to be in metres [m]."""
MANY_FACES = 100_000
"""Meshes with more faces are decimated."""
CLOUD_SUFFIXES = {".npy", ".pcd"}
MIN_CLOUD = 16
"""Fewest distinct points of a bare cloud."""
NEIGHBOURS = 16
"""Neighbours for the normals of a bare cloud."""


def load_file(path: Path, *, scale: float = 1.0) -> ObjectModel:
    """Read a mesh in any format trimesh knows, or a point cloud (PLY without faces, NPY, PCD).

    Args:
        path: The file.
        scale: Multiplies all coordinates; 0.001 for files in millimetres.

    Raises:
        ObjectError: The file cannot be used; the message says why and what to do.
    """
    if not path.is_file():
        raise ObjectError(f"no object file at {path}; give an existing mesh or point cloud, or a name that "
                          "`dro-grasp objects` lists")
    if path.suffix.lower() in CLOUD_SUFFIXES:
        return cloud_object(path.stem, _read_cloud(path) * scale, str(path))
    import trimesh

    try:
        geometry = trimesh.load(path, process=False)
    except Exception as error:  # every reader behind trimesh has errors of its own
        raise ObjectError(f"{path} cannot be read as a mesh or cloud: {error}. Expected a format that trimesh reads "
                          "(STL, OBJ, PLY, GLB, OFF, ...), NPY or PCD") from error
    if isinstance(geometry, trimesh.PointCloud):
        return cloud_object(path.stem, np.asarray(geometry.vertices) * scale, str(path))
    mesh = geometry.to_mesh() if isinstance(geometry, trimesh.Scene) else geometry
    return mesh_object(path.stem, mesh, origin=str(path), scale=scale)


def mesh_object(
    name: str, mesh: trimesh.Trimesh, *, origin: str, scale: float = 1.0, split: str | None = None,
    parts: tuple[Part, ...] | None = None,
) -> ObjectModel:
    """Check and repair a mesh, and derive mass properties and the stored cloud.

    Raises:
        ObjectError: NaN vertices, no faces, no volume, or a size that is no object's in metres.
    """
    import trimesh

    notes: list[str] = []
    vertices, faces = np.asarray(mesh.vertices, np.float64) * scale, np.asarray(mesh.faces, np.int64)
    _check_numbers(vertices, faces, origin)
    _check_size(np.ptp(vertices, axis=0), origin)
    clean = _repair(trimesh.Trimesh(vertices, faces, process=True), notes)
    volume, centre, inertia = _mass_properties(clean, origin, notes)
    points, face = trimesh.sample.sample_surface(clean, CLOUD_POINTS, seed=0)
    vertices, faces = np.asarray(clean.vertices), np.asarray(clean.faces)
    return ObjectModel(
        name=name, cloud=np.asarray(points, np.float32), cloud_normals=np.asarray(clean.face_normals[face], np.float32),
        centre_of_mass=centre, sha256=content_hash(vertices.astype(np.float32), faces.astype(np.int32)),
        vertices=vertices, faces=faces, volume=volume, inertia=inertia, notes=tuple(notes), split=split, exact_parts=parts,
    )


def cloud_object(name: str, points: np.ndarray, origin: str) -> ObjectModel:
    """A bare point cloud (n 3) or cloud with normals (n 6) [m].

    Raises:
        ObjectError: NaN, too few distinct points, or a size that is no object's in metres.
    """
    if points.ndim != 2 or points.shape[1] not in (3, 6):
        raise ObjectError(f"{origin} holds an array of shape {points.shape}; expected (n, 3) points or (n, 6) points "
                          "with normals")
    if not np.isfinite(points).all():
        raise ObjectError(f"{origin} has {int((~np.isfinite(points)).any(1).sum())} points with NaN or infinite "
                          "coordinates; remove them first")
    distinct = len(np.unique(points[:, :3].round(6), axis=0))
    if distinct < MIN_CLOUD:
        raise ObjectError(f"{origin} has {distinct} distinct points; a cloud needs at least {MIN_CLOUD} spread over the "
                          "object's surface")
    xyz = points[:, :3].astype(np.float32)
    _check_size(np.ptp(xyz, axis=0), origin)
    rng = np.random.default_rng(0)
    keep = rng.permutation(len(xyz))[:CLOUD_POINTS]
    xyz = xyz[keep]
    normals = points[keep, 3:].astype(np.float32) if points.shape[1] == 6 else _estimate_normals(xyz)
    return ObjectModel(
        name=name, cloud=np.ascontiguousarray(xyz), cloud_normals=np.ascontiguousarray(normals),
        centre_of_mass=xyz.mean(0).astype(np.float64), sha256=content_hash(xyz),
        notes=(f"bare point cloud of {len(points)} points: no trial is possible without a mesh",),
    )


def _check_numbers(vertices: np.ndarray, faces: np.ndarray, origin: str) -> None:
    if len(faces) == 0:
        raise ObjectError(f"{origin} has {len(vertices)} vertices and no faces; give a triangle mesh, or a point cloud "
                          "as PLY, NPY or PCD")
    bad = int((~np.isfinite(vertices)).any(1).sum())
    if bad:
        raise ObjectError(f"{origin} has {bad} vertices with NaN or infinite coordinates; repair the mesh first")


def _check_size(extents: np.ndarray, origin: str) -> None:
    largest = float(extents.max())
    if largest > LARGEST:
        guess = 0.001 if largest > 20 else 0.1 if largest < 5 else 0.01
        raise ObjectError(f"{origin} is {largest:.4g} m large, too large for a hand; if its units are not metres, give "
                          f"--scale (millimetres: --scale 0.001; here perhaps --scale {guess:g})")
    if largest < SMALLEST:
        raise ObjectError(f"{origin} is {largest * 1000:.3g} mm large, too small for a hand; if its units are not metres, "
                          "give --scale (for example --scale 1000)")


def _repair(mesh: trimesh.Trimesh, notes: list[str]) -> trimesh.Trimesh:
    """Merge, decimate, close and turn outward, as far as that is safe."""
    import trimesh

    if len(mesh.faces) > MANY_FACES:
        before = len(mesh.faces)
        mesh = mesh.simplify_quadric_decimation(face_count=MANY_FACES // 2)
        notes.append(f"decimated from {before} to {len(mesh.faces)} faces")
    if not mesh.is_watertight:
        mesh.update_faces(mesh.nondegenerate_faces())
        trimesh.repair.fill_holes(mesh)
        notes.append("holes were closed" if mesh.is_watertight else
                     "not watertight: distances use winding numbers, which cope with small holes")
    if not mesh.is_winding_consistent or mesh.volume < 0:
        trimesh.repair.fix_normals(mesh, multibody=True)
        notes.append("faces were turned outward")
    return mesh


def _mass_properties(
    mesh: trimesh.Trimesh, origin: str, notes: list[str]
) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume, centre of mass and unit-density inertia; those of the hull where the mesh encloses nothing sensible."""
    import trimesh
    from scipy.spatial import QhullError

    try:
        hull = trimesh.convex.convex_hull(mesh)
    except QhullError:
        hull = None
    box = float(np.prod(mesh.extents))
    if hull is None or hull.volume < 1e-3 * max(box, 1e-12) or hull.volume < 1e-9:
        raise ObjectError(f"{origin} encloses no volume (extents {np.round(mesh.extents * 1000, 2).tolist()} mm); give a "
                          "closed solid, or a point cloud if only its surface is known")
    body = mesh
    if not 0.02 * hull.volume < mesh.volume <= 1.001 * hull.volume:
        notes.append("volume and mass are those of the convex hull, because the mesh encloses none")
        body = hull
    body = body.copy()
    body.density = 1.0
    return float(body.volume), np.asarray(body.center_mass), np.asarray(body.moment_inertia)


def _estimate_normals(points: np.ndarray) -> np.ndarray:
    """Normals by local principal axes, turned away from the middle of the cloud."""
    from scipy.spatial import cKDTree

    neighbours = cKDTree(points).query(points, k=min(NEIGHBOURS, len(points)))[1]
    local = points[neighbours] - points[neighbours].mean(1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))[1][:, :, 0]
    outward = ((points - points.mean(0)) * normals).sum(1) >= 0
    return np.where(outward[:, None], normals, -normals).astype(np.float32)


def _read_cloud(path: Path) -> np.ndarray:
    if path.suffix.lower() == ".npy":
        try:
            return np.asarray(np.load(path, allow_pickle=False), np.float64)
        except (ValueError, EOFError) as error:
            raise ObjectError(f"{path} is no plain NPY array ({error}); save it with numpy.save as floats") from error
    return _read_pcd(path)


def _read_pcd(path: Path) -> np.ndarray:
    """Points of a PCD file, ascii or binary.

    Raises:
        ObjectError: The header is not one of a PCD, or the data are compressed or cut short.
    """
    raw = path.read_bytes()
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
    try:
        fields, count, kind = header["FIELDS"], int(header["POINTS"][0]), header["DATA"][0]
        columns = [fields.index(axis) for axis in "xyz"]
        if kind == "ascii":
            rows = np.array([line.split() for line in raw[position:].splitlines()[:count]], dtype=np.float64)
            return rows[:, columns]
        if kind != "binary":
            raise ObjectError(f"{path} holds {kind} data; save the cloud as ascii or binary PCD")
        letters = {"F": "f", "I": "i", "U": "u"}
        sizes = zip(header["TYPE"], header["SIZE"], header.get("COUNT", ["1"] * len(fields)), strict=True)
        layout = np.dtype([(f"{i}", f"<{letters[t]}{s}", (int(c),)) for i, (t, s, c) in enumerate(sizes)])
        table = np.frombuffer(raw, layout, count=count, offset=position)
        return np.stack([table[f"{c}"][:, 0].astype(np.float64) for c in columns], 1)
    except (KeyError, ValueError, IndexError) as error:
        raise ObjectError(f"{path} is a damaged PCD file ({error}); expected fields x y z and all its points") from error
