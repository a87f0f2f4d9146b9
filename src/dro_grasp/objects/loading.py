"""From a mesh or a cloud to an ObjectModel: checks, and what is said of what was changed."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Num
from scipy.spatial import KDTree

from dro_grasp.errors import ObjectError, UngraspableError
from dro_grasp.files import given_path
from dro_grasp.geometry.cache import content_hash
from dro_grasp.geometry.mesh_files import trimesh
from dro_grasp.geometry.point_clouds import distinct_points
from dro_grasp.geometry.point_groups import local_normals
from dro_grasp.geometry.table_plane import above_plane, table_plane
from dro_grasp.objects.convex_parts import Part
from dro_grasp.objects.mending import check_surface, mass_properties, repair
from dro_grasp.objects.perception.things import AS_SCENE, one_thing, refuse_scene
from dro_grasp.objects.reading import ORIGIN, geometry_in_memory, in_rows, read_geometry, refuse_image, returned
from dro_grasp.objects.shape import CLOUD_POINTS, ObjectModel

LARGEST = 1.0  # Largest extent of an object that counts as metres [m] (ours)
SMALLEST = 0.005  # Smallest such extent [m] (ours)
FITTING = 0.5  # Largest extent that a hint suggests [m] (ours)
UNITS = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254, "metres": 1.0}
"""Units that files use [m]."""
UNIT_OF = {".stl": "millimetres", ".3mf": "millimetres", ".off": "millimetres", ".glb": "metres", ".gltf": "metres",
           ".dae": "metres", ".obj": "centimetres"}
"""Units of formats, or what most programs write in them (ours); of others, metres."""
FARTHEST_VIEW = 20.0  # Largest extent of a view of a depth camera [m] (ours)
FARTHEST = 100.0  # Largest coordinate [m] (ours): single precision rounds it by 4 micrometres
MIN_CLOUD = 16  # Fewest distinct points of a bare cloud (ours)
LINE = 1e-5  # Root mean square distance of points from a line up to which they lie on it [m] (ours)
ONE_SIDED = 0.3  # Mean of the normals above which a cloud is one side of an object [1] (ours)
ONE_COLOUR = 0.999  # Length of the mean of unit vectors from which on they are one vector for all points [1] (ours)
NEIGHBOURS = 16  # Neighbours that estimate the normals of a bare cloud (ours)


def load_file(path: Path, *, scale: float = 1.0, keep_table: bool = False) -> ObjectModel:
    """Read a mesh in any format trimesh knows, or a point cloud (PLY without faces, NPY, PCD).

    A unit stated in the file (glTF, 3MF, DAE) is honoured; `scale` multiplies all coordinates.
    """
    path = given_path(path)
    if not path.is_file():
        raise ObjectError(f"no object file at {path}; give an existing mesh or point cloud, or a name that "
                          "`dro-grasp objects` lists")
    geometry = read_geometry(path)
    if isinstance(geometry, np.ndarray):
        return cloud_object(path.stem, geometry, origin=str(path), scale=scale, keep_table=keep_table,
                            named_normals=path.suffix.lower() != ".npy")
    return mesh_object(path.stem, geometry, origin=str(path), scale=scale)


def object_in_memory(source: Any, scale: float = 1.0, keep_table: bool = False) -> ObjectModel:
    """An object from a trimesh mesh, cloud or scene, from (vertices, faces), or from points (n 3) or with normals (n 6)."""
    geometry = geometry_in_memory(source)
    if isinstance(geometry, trimesh.Trimesh):
        return mesh_object("mesh", geometry, origin=ORIGIN, scale=scale)
    return cloud_object("cloud", geometry, origin=ORIGIN, scale=scale, keep_table=keep_table, named_normals=False)


def mesh_object(
    name: str, mesh: trimesh.Trimesh, *, origin: str, scale: float = 1.0, split: str | None = None,
    parts: tuple[Part, ...] | None = None,
) -> ObjectModel:
    """Check and repair a mesh, and derive mass properties and the stored cloud; the parts are scaled as well.

    Messages name the `origin`; `split` is `train`, `validate`, `test`, or None for a user's object.
    """
    notes: list[str] = []
    vertices, faces = np.asarray(mesh.vertices, np.float64) * scale, np.asarray(mesh.faces, np.int64)
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
        raise ObjectError(f"{origin} has vertices {vertices.shape} and faces {faces.shape}; expected triangles in space: "
                          "export it again")
    _check_numbers(vertices, faces, origin)
    used = np.bincount(faces.ravel(), minlength=len(vertices)) > 0
    check_extent(vertices[used], origin, scale)
    merged = trimesh.Trimesh(vertices, faces, process=True)
    check_surface(merged, origin)
    duplicated = int(used.sum()) - len(merged.vertices)
    soup = used.sum() == 3 * len(faces)  # every STL file repeats its vertices: not worth a note
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
        exact_parts=None if parts is None else tuple((v * scale, f) for v, f in parts))


def cloud_object(
    name: str, points: Num[np.ndarray, "..."], *, origin: str, scale: float = 1.0, keep_table: bool = False,
    seen: Float[np.ndarray, "m 3"] | None = None, named_normals: bool | None = None,
) -> ObjectModel:
    """An object from a bare point cloud (n 3), or a cloud with normals (n 6), organised or not; only the points are scaled.

    `keep_table` takes every point for the object's; `seen` is what was seen of it, where the rest of the cloud is a guess [m].
    Normals are kept where `named_normals` is None; else they are turned or estimated where they are no outward ones. False:
    nothing calls columns 4 to 6 normals.
    """
    refuse_image(points, origin)
    points = in_rows(points)
    if points.ndim != 2 or points.shape[1] not in (3, 6):
        raise ObjectError(f"{origin} holds an array of shape {points.shape}; expected (n, 3) points or (n, 6) points "
                          "with normals")
    points, dropped = _where_seen(points)
    xyz = points[:, :3] * scale
    one = distinct_points(xyz)
    merged = () if len(one) == len(points) else (f"merged {len(points) - len(one)} duplicated points",)
    xyz, points, total = xyz[one], points[one], len(one)
    whole, table = xyz, None if keep_table else table_plane(xyz)
    if table is not None:
        kept = above_plane(xyz, table)
        xyz, points = xyz[kept], points[kept]
    cut = () if table is None else (table_note(table, total - len(points), total),)
    if not keep_table:
        own, apart = one_thing(xyz, table is not None, origin)
        xyz, points, cut = xyz[own], points[own], (*cut, *apart)
    keep = np.random.default_rng(0).permutation(len(xyz))[:CLOUD_POINTS]
    if len(xyz) and np.ptp(xyz, axis=0).max() > 0:
        check_view(xyz, origin, scale)
    if not keep_table:
        refuse_scene(whole, xyz, origin)
    if len(xyz) < MIN_CLOUD:
        raise ObjectError(f"{origin} has {len(xyz)} distinct points; a cloud needs at least {MIN_CLOUD} spread over "
                          "the object's surface")
    if np.linalg.svd(xyz - xyz.mean(0), compute_uv=False)[1] < LINE * math.sqrt(len(xyz)):
        raise ObjectError(f"the {len(xyz)} points of {origin} lie on one line; give a cloud of the object's surface")
    cloud = np.ascontiguousarray(xyz[keep], np.float32)
    normals, odd = given_normals(cloud, points[keep, 3:], origin, named_normals)
    has_normals = normals is not None
    normals = normals if normals is not None else estimate_normals(cloud)
    fewer = f", {CLOUD_POINTS} of them kept" if len(points) > CLOUD_POINTS else ""
    estimated = "" if has_normals else "; normals were estimated, and cavities, as in a bowl, count as filled"
    return ObjectModel(
        name=name, cloud=cloud, cloud_normals=np.ascontiguousarray(normals, np.float32),
        centre_of_mass=cloud.mean(0, dtype=np.float64), sha256=content_hash(cloud),
        table=table, seen=None if seen is None else seen.astype(np.float32),
        notes=(f"bare point cloud of {len(points)} points{fewer}{estimated}: no trial is possible without a mesh", *dropped,
               *merged, *cut, *odd, *(() if has_normals else _one_sided(normals))))


def _where_seen(points: Num[np.ndarray, "n k"]) -> tuple[Num[np.ndarray, "m k"], tuple[str, ...]]:
    """The points where something was seen, and how many are none."""
    kept = returned(points[:, :3])
    return (points, ()) if kept.all() else (points[kept], (dropped_note(int((~kept).sum()), len(kept)),))


def dropped_note(count: int, total: int) -> str:
    """What to say of points where nothing was seen."""
    return f"{count} of {total} points are none (NaN, or 0 0 0 for no return) and were dropped"


def given_normals(
    cloud: Float[np.ndarray, "n 3"], given: Num[np.ndarray, "n k"], origin: str, named: bool | None
) -> tuple[Float[np.ndarray, "n 3"] | None, tuple[str, ...]]:
    """Unit normals as they were given, turned if they are inward all over; None to estimate them. And what to say."""
    if given.shape[1] != 3:
        return None, ()
    length = np.linalg.norm(given, axis=1, keepdims=True)
    unit = bool(np.isfinite(length).all()) and length.min() > 1e-6 and length.max() < 1.2 * length.min()  # (ours)
    if unit and abs(float(length.mean()) - 1) > 0.2:  # one vector for all points, and no unit vector, is a colour
        unit = float(np.linalg.norm((given / length).mean(0))) < ONE_COLOUR
    if not unit and not named and length.min() > 1e-6:  # something else, such as colours
        raise ObjectError(f"{origin} has vectors of length {length.min():.3g} to {length.max():.3g} in its columns 4 to 6, "
                          "which are no normals; expected unit normals, or (n, 3) points alone: normals are then estimated")
    if not unit and not named:
        return None, ()
    if not unit:
        return None, ("its normals have not all one length, so they were not used",)
    normals = given / length
    if named is None:
        return normals, ()
    if _contradict(cloud, normals):
        return None, ("its normals point to both sides of one surface, so they were not used",)
    # The volume that a closed cloud encloses is negative where its normals point inward. One side alone encloses none.
    inward = float(((cloud - cloud.mean(0)) * normals).sum()) < 0 and np.linalg.norm(normals.mean(0)) <= ONE_SIDED
    return (-normals, ("its normals pointed inward and were turned",)) if inward else (normals, ())


def _contradict(cloud: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> bool:
    """Whether many neighbours on one surface have opposite normals, as those have that no one turned outward."""
    some = np.arange(0, len(cloud), max(1, len(cloud) // 1000))
    distance, near = KDTree(cloud).query(cloud[some], k=min(NEIGHBOURS, len(cloud)))
    opposite = np.einsum("nki,ni->nk", normals[near], normals[some]) < -0.5
    # Both sides of a thin sheet have opposite normals, too, but lie above one another.
    height = np.abs(np.einsum("nki,ni->nk", cloud[near] - cloud[some][:, None], normals[some]))
    return float((opposite & (height < 0.2 * distance))[:, 1:].mean()) > 0.1  # (ours)


def _one_sided(normals: Float[np.ndarray, "n 3"]) -> tuple[str, ...]:
    """A question if all points face one way, as if one camera had seen them."""
    # Over closed surfaces normals add up to nothing, over half a ball their mean is 0.5; a bowl seen from everywhere asks, too.
    if np.linalg.norm(normals.mean(0)) <= ONE_SIDED:
        return ()
    return ("its points face mostly one way, and all of them count as the whole object; if they are what one camera saw, give "
            "its pose with camera=..., scanned_object in Python: the side that it did not see is then added",)


def table_note(table: Float[np.ndarray, "4"], removed: int, total: int) -> str:
    """What to say of a table that was cut off."""
    x, y, z, height = (round(float(value), 3) + 0.0 for value in table)
    return (f"a table was found in the cloud (all points where {x:g} x + {y:g} y + {z:g} z = {height:g} m) and {removed} of "
            f"{total} points were cut off with it; hands stay above it. Keep them with keep_table=True")


def estimate_normals(
    points: Float[np.ndarray, "n 3"], camera: Float[np.ndarray, "3"] | None = None
) -> Float[np.ndarray, "n 3"]:
    """Unit normals of a cloud by local principal axes, turned to the camera, or away from the cloud's mean without one."""
    normals = local_normals(points, NEIGHBOURS)
    towards = points - points.mean(0) if camera is None else camera - points
    outward = (towards * normals).sum(1) >= 0
    return np.where(outward[:, None], normals, -normals).astype(np.float32)


def _check_numbers(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "..."], origin: str) -> None:
    """Refuse meshes without faces, with wrong indices or with NaN."""
    if len(faces) == 0:
        raise ObjectError(f"{origin} has {len(vertices)} vertices and no faces; give a triangle mesh, or a point cloud "
                          "as PLY, NPY or PCD")
    if faces.min() < 0 or faces.max() >= len(vertices):
        wrong = faces.min() if faces.min() < 0 else faces.max()
        raise ObjectError(f"{origin} has a face with vertex {wrong}, and vertices 0 to {len(vertices) - 1}; the file is "
                          "damaged, export it again")
    bad = int((~np.isfinite(vertices)).any(1).sum())
    if bad:
        raise ObjectError(f"{origin} has {bad} vertices with NaN or infinite coordinates; repair the mesh first")


def check_scale(scale: float) -> None:
    """Refuse a factor that is no positive number, by an ObjectError."""
    if not (math.isfinite(scale) and scale > 0):
        raise ObjectError(f"scale is {scale}; give a positive number, for example scale=0.001 for millimetres")


def check_extent(points: Float[np.ndarray, "n 3"], origin: str, scale: float = 1.0) -> None:
    """Refuse sizes and places that are implausible in metres, by an ObjectError that suggests a scale in place of `scale`."""
    # Most files state no unit, and a wrong guess would grasp air.
    largest, farthest = float(np.ptp(points, axis=0).max()), float(np.abs(points).max())
    if SMALLEST <= largest <= LARGEST and farthest > FARTHEST:
        raise ObjectError(f"{origin} has coordinates of up to {farthest:.3g} m, too large for single precision; move it to "
                          f"within {FARTHEST:g} m of its origin")
    if SMALLEST <= largest <= LARGEST:
        return
    if largest <= 0:
        raise ObjectError(f"{origin} is a single point; give a mesh or cloud that has an extent")
    size = f"{largest:.4g} m, too large" if largest > LARGEST else f"{largest * 1000:.3g} mm, too small"
    raise UngraspableError(f"{origin} measures {size}", " for a hand to grasp; if its unit is not the metre, give "
                           f"{_scale_hint(largest / scale, origin)}")


def check_view(points: Float[np.ndarray, "n 3"], origin: str, scale: float = 1.0) -> None:
    """Refuse clouds of implausible sizes, as `check_extent` does; those as large as a view may be one."""
    largest = float(np.ptp(points, axis=0).max())
    if LARGEST < largest <= FARTHEST_VIEW:
        raise UngraspableError(f"{origin} measures {largest:.4g} m, too large", " for a hand to grasp; if it is a camera's "
                               f"view in metres, {AS_SCENE}; if its unit is not the metre, give "
                               f"{_scale_hint(largest / scale, origin)}")
    check_extent(points, origin, scale)


def _scale_hint(largest: float, origin: str) -> str:
    """Scales that make a thing that measures so much in its file [the file's unit] fit a hand, the likeliest first."""
    own = UNIT_OF.get(Path(origin).suffix.lower(), "metres")
    fits = [(unit, scale) for unit, scale in UNITS.items() if SMALLEST <= largest * scale <= FITTING]
    if not fits:
        power = 10.0 ** math.ceil(math.log10(0.03 / largest))  # suggests 3 to 30 cm (ours)
        return f"a scale: scale={power:.3g} makes it {largest * power * 100:.3g} cm"
    # After the format's own unit, that comes first which makes it as large as most things that are grasped.
    fits.sort(key=lambda fit: (fit[0] != own, abs(math.log(largest * fit[1] / 0.1))))
    return "; ".join(f"scale={scale:g} for {unit}, which makes it {largest * scale * 100:.3g} cm" for unit, scale in fits)
