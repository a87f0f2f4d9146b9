"""From a file to an ObjectModel: reading, checks, safe repairs, all of it reported."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dro_grasp.errors import ObjectError
from dro_grasp.objects.cache import content_hash
from dro_grasp.objects.cloud_files import CLOUD_SUFFIXES, read_cloud
from dro_grasp.objects.convex_parts import Part
from dro_grasp.objects.repair import mass_properties, repair
from dro_grasp.objects.shape import CLOUD_POINTS, ObjectModel

if TYPE_CHECKING:
    import trimesh

LARGEST, SMALLEST = 1.0, 0.005
"""Extents between which an object is believed to be in metres [m]."""
USUAL = 0.03
"""A suggested scale gives a size between this and ten times this [m]."""
MIN_CLOUD = 16
"""Fewest distinct points of a bare cloud."""
NEIGHBOURS = 16
"""Neighbours for the normals of a bare cloud."""


def load_file(path: Path, *, scale: float = 1.0) -> ObjectModel:
    """Read a mesh in any format trimesh knows, or a point cloud (PLY without faces, NPY, PCD).

    Args:
        path: The file. A unit that it states (glTF, 3MF, DAE) is honoured.
        scale: Multiplies all coordinates; 0.001 for files in millimetres that do not say so.

    Raises:
        ObjectError: The file cannot be used; the message says why and what to do.
    """
    if not path.is_file():
        raise ObjectError(f"no object file at {path}; give an existing mesh or point cloud, or a name that "
                          "`dro-grasp objects` lists")
    if path.suffix.lower() in CLOUD_SUFFIXES:
        return cloud_object(path.stem, read_cloud(path), origin=str(path), scale=scale)
    geometry, unit = read_geometry(path)
    if isinstance(geometry, np.ndarray):
        return cloud_object(path.stem, geometry * unit, origin=str(path), scale=scale)
    if unit != 1.0:
        geometry.apply_scale(unit)
    return mesh_object(path.stem, geometry, origin=str(path), scale=scale)


def read_points(path: Path) -> np.ndarray:
    """Points (n 3) of a cloud file as float64 [its unit, metres where it states one], as they are: NaN and strays as well.

    Raises:
        ObjectError: There is no such file, it is damaged, or it holds a mesh.
    """
    if not path.is_file():
        raise ObjectError(f"no file at {path}; with --camera give a cloud (PLY, NPY, PCD). What has a name is a mesh, which no "
                          "camera has seen")
    if path.suffix.lower() in CLOUD_SUFFIXES:
        points = read_cloud(path)
        if points.ndim != 2 or points.shape[1] < 3:
            raise ObjectError(f"{path} holds an array of shape {points.shape}; expected (n, 3) points")
        return points[:, :3]
    geometry, unit = read_geometry(path)
    if not isinstance(geometry, np.ndarray):
        raise ObjectError(f"{path} is a mesh, which no camera has seen; leave out --camera, or give a cloud (PLY, NPY, PCD)")
    return geometry * unit


def read_geometry(path: Path) -> tuple[trimesh.Trimesh | np.ndarray, float]:
    """One mesh, scenes merged, or the points (n 3) of a file without faces; and its stated unit [m].

    Raises:
        ObjectError: No reader can make a mesh or cloud of it.
    """
    import trimesh

    try:
        loaded = trimesh.load(path, process=False)
        unit = trimesh.units.unit_conversion(loaded.units, "meters") if loaded.units else 1.0
        geometry = _merge(loaded) if isinstance(loaded, trimesh.Scene) else loaded
    except Exception as error:  # every reader behind trimesh has errors of its own
        raise ObjectError(f"{path} cannot be read as a mesh or cloud: {error}. Expected a format that trimesh reads "
                          "(STL, OBJ, PLY, GLB, OFF, ...), NPY or PCD") from error
    if isinstance(geometry, trimesh.PointCloud):
        return np.asarray(geometry.vertices, np.float64), unit
    if not isinstance(geometry, trimesh.Trimesh):
        raise ObjectError(f"{path} holds a {type(geometry).__name__}, which has no faces; give a triangle mesh, or a "
                          "point cloud as PLY, NPY or PCD")
    return geometry, unit


def _merge(scene: trimesh.Scene) -> trimesh.Trimesh | trimesh.PointCloud:
    """All meshes of a scene where they stand in it, or its point clouds where it has no mesh."""
    import trimesh

    mesh = scene.to_mesh()
    clouds = [part.vertices for part in scene.dump() if isinstance(part, trimesh.PointCloud)]
    return trimesh.PointCloud(np.concatenate(clouds)) if clouds and len(mesh.faces) == 0 else mesh


def mesh_object(
    name: str, mesh: trimesh.Trimesh, *, origin: str, scale: float = 1.0, split: str | None = None,
    parts: tuple[Part, ...] | None = None,
) -> ObjectModel:
    """Check and repair a mesh, and derive mass properties and the stored cloud.

    Args:
        name: Name of the object.
        mesh: Its mesh, in metres after scaling.
        origin: Where the mesh comes from, for messages.
        scale: Multiplies all coordinates, those of the parts too.
        split: `train`, `validate`, `test`, or None for an object of the user's.
        parts: Convex parts where they are known.

    Raises:
        ObjectError: NaN vertices, no faces, no volume, or a size that is no object's in metres.
    """
    import trimesh

    notes: list[str] = []
    vertices, faces = np.asarray(mesh.vertices, np.float64) * scale, np.asarray(mesh.faces, np.int64)
    _check_numbers(vertices, faces, origin)
    used = np.bincount(faces.ravel(), minlength=len(vertices)) > 0
    _check_size(np.ptp(vertices[used], axis=0), origin, scale)
    merged = trimesh.Trimesh(vertices, faces, process=True)
    duplicated = int(used.sum()) - len(merged.vertices)
    soup = used.sum() == 3 * len(faces)  # as in every STL file, where it says nothing about the mesh
    if duplicated and not soup:
        notes.append(f"merged {duplicated} duplicated vertices")
    clean = repair(merged, notes)
    volume, centre, inertia = mass_properties(clean, origin, notes)
    points, face = trimesh.sample.sample_surface(clean, CLOUD_POINTS, seed=0)[:2]
    vertices, faces = np.asarray(clean.vertices), np.asarray(clean.faces)
    return ObjectModel(
        name=name, split=split, notes=tuple(notes),
        cloud=np.asarray(points, np.float32), cloud_normals=np.asarray(clean.face_normals[face], np.float32),
        sha256=content_hash(vertices.astype(np.float32), faces.astype(np.int32)), vertices=vertices, faces=faces,
        volume=volume, centre_of_mass=centre, inertia=inertia,
        exact_parts=None if parts is None else tuple((v * scale, f) for v, f in parts),
    )


def cloud_object(name: str, points: np.ndarray, *, origin: str, scale: float = 1.0) -> ObjectModel:
    """A bare point cloud (n 3) or cloud with normals (n 6); only the points are scaled.

    Raises:
        ObjectError: NaN, too few distinct points, or a size that is no object's in metres.
    """
    if points.ndim != 2 or points.shape[1] not in (3, 6):
        raise ObjectError(f"{origin} holds an array of shape {points.shape}; expected (n, 3) points or (n, 6) points "
                          "with normals")
    bad = int((~np.isfinite(points)).any(1).sum())
    if bad:
        raise ObjectError(f"{origin} has {bad} points with NaN or infinite coordinates; remove them first")
    xyz = points[:, :3] * scale
    keep = np.random.default_rng(0).permutation(len(xyz))[:CLOUD_POINTS]
    distinct = len(np.unique(xyz[keep].round(6), axis=0))
    if len(xyz) and np.ptp(xyz, axis=0).max() > 0:
        _check_size(np.ptp(xyz, axis=0), origin, scale)
    if distinct < MIN_CLOUD:
        raise ObjectError(f"{origin} has {distinct} distinct points; a cloud needs at least {MIN_CLOUD} spread over "
                          "the object's surface")
    cloud = np.ascontiguousarray(xyz[keep], np.float32)
    given = points[keep, 3:]
    length = np.linalg.norm(given, axis=1, keepdims=True)
    has_normals = points.shape[1] == 6 and length.min() > 1e-6
    normals = given / length if has_normals else estimate_normals(cloud)
    fewer = f", {CLOUD_POINTS} of them kept" if len(points) > CLOUD_POINTS else ""
    estimated = "" if has_normals else "; normals were estimated"
    return ObjectModel(
        name=name, cloud=cloud, cloud_normals=np.ascontiguousarray(normals, np.float32),
        centre_of_mass=cloud.mean(0, dtype=np.float64), sha256=content_hash(cloud),
        notes=(f"bare point cloud of {len(points)} points{fewer}{estimated}: no trial is possible without a mesh",),
    )


def estimate_normals(points: np.ndarray, camera: np.ndarray | None = None) -> np.ndarray:
    """Unit normals of a cloud (n 3) by local principal axes, turned to the camera (3), or away from the cloud's middle."""
    from scipy.spatial import KDTree

    neighbours = KDTree(points).query(points, k=min(NEIGHBOURS, len(points)))[1]
    local = points[neighbours] - points[neighbours].mean(1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))[1][:, :, 0]
    towards = points - points.mean(0) if camera is None else camera - points
    outward = (towards * normals).sum(1) >= 0
    return np.where(outward[:, None], normals, -normals).astype(np.float32)


def _check_numbers(vertices: np.ndarray, faces: np.ndarray, origin: str) -> None:
    if len(faces) == 0:
        raise ObjectError(f"{origin} has {len(vertices)} vertices and no faces; give a triangle mesh, or a point cloud "
                          "as PLY, NPY or PCD")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ObjectError(f"{origin} has a face with vertex {faces.max()}, and only {len(vertices)} vertices; the file "
                          "is damaged, export it again")
    bad = int((~np.isfinite(vertices)).any(1).sum())
    if bad:
        raise ObjectError(f"{origin} has {bad} vertices with NaN or infinite coordinates; repair the mesh first")


def _check_size(extents: np.ndarray, origin: str, scale: float) -> None:
    """Refuse what is no object in metres: most files do not say their unit, and a wrong guess would grasp air."""
    largest = float(extents.max())
    if SMALLEST <= largest <= LARGEST:
        return
    if largest <= 0:
        raise ObjectError(f"{origin} is a single point; give a mesh or cloud that has an extent")
    size = f"{largest:.4g} m, too large" if largest > LARGEST else f"{largest * 1000:.3g} mm, too small"
    power = 10.0 ** math.ceil(math.log10(USUAL / largest))
    raise ObjectError(f"{origin} measures {size} for a hand to grasp; if its unit is not the metre, give --scale: 0.001 "
                      f"for millimetres; {scale * power:.3g} makes it {largest * power * 100:.2g} cm")
