"""Safe repairs of a mesh, and its mass properties; each finding gets a note."""

from __future__ import annotations

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import QhullError

from dro_grasp.errors import ObjectError
from dro_grasp.geometry.point_clouds import enclosed_volume

LEAST_FILL = 1e-3
"""Share of its bounding box that a hull must fill, and share of its hull that a closed mesh must fill (ours); less is a
sheet."""
OPEN_FILL = 0.05  # Share of its hull that a mesh with holes must fill (ours); a bent sheet appears to fill a little
OVERLAP = 1e-3  # Share of the volume by which bodies may overlap without being joined (ours)

MassProperties = tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]
"""Volume [m^3], centre of mass [m], and inertia about it at unit density [m^5]."""


def check_surface(mesh: trimesh.Trimesh, origin: str) -> None:
    """Refuse faces without area, and soups of faces, in which inside and outside take minutes to tell, by an ObjectError."""
    if not (len(mesh.faces) and mesh.nondegenerate_faces().any()):
        raise ObjectError(f"{origin} has {len(mesh.faces)} faces, none of which has an area; give a triangle mesh of a solid")
    edges = mesh.faces_unique_edges[mesh.unique_faces()]  # a face and its reverse side count once
    alone = float((np.unique(edges, return_counts=True)[1] == 1).mean())
    if len(mesh.faces) > 100 and alone > 0.9:  # (ours) fewer faces are quick, whatever they are
        raise ObjectError(f"{origin} is no surface: {alone:.0%} of the edges of its {len(mesh.faces)} faces belong to one face "
                          "alone; join the faces (merge vertices), or give a point cloud of the surface")


def repair(mesh: trimesh.Trimesh, notes: list[str]) -> trimesh.Trimesh:
    """Decimate, close, turn outward and join a mesh with merged vertices, as far as that is safe; `notes` gets each finding."""
    if (before := len(mesh.faces)) > 100_000:  # (ours)
        mesh = mesh.simplify_quadric_decimation(face_count=50_000)
        notes.append(f"decimated from {before} to {len(mesh.faces)} faces")
    if not mesh.is_watertight:
        _close(mesh, notes)
    if _turn_outward(mesh):
        notes.append("faces were turned outward")
    return _join(mesh, notes)


def mass_properties(mesh: trimesh.Trimesh, origin: str, notes: list[str]) -> MassProperties:
    """Volume, centre of mass and inertia; an ObjectError if not even the convex hull encloses a volume.

    A mesh with holes is measured by the points inside by their winding number, a sheet by its convex hull.
    """
    hull = _hull(mesh)
    box = float(np.prod(mesh.extents))
    if hull is None or hull.volume < max(LEAST_FILL * box, 1e-9):  # [m^3] (ours)
        raise ObjectError(f"{origin} encloses no volume (extents {np.round(mesh.extents * 1000, 2).tolist()} mm); "
                          "give a closed solid, or a point cloud if only its surface is known")
    if _is_solid(mesh) and LEAST_FILL * hull.volume < _volume(mesh) <= (1 + OVERLAP) * hull.volume:
        return _of_solid(mesh)
    winding, points, cell = _winding(mesh)
    inside = points[np.abs(winding) > 0.5]
    if len(inside) * cell > max(OPEN_FILL * hull.volume, 100 * cell):
        return _of_points(inside, cell)
    notes.append("volume and mass are those of the convex hull, because the mesh encloses none")
    return _of_solid(hull)


def _close(mesh: trimesh.Trimesh, notes: list[str]) -> None:
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    mesh.remove_unreferenced_vertices()
    trimesh.repair.fill_holes(mesh)
    notes.append("holes were closed" if mesh.is_watertight else
                 "not watertight: distances use winding numbers, which cope with small holes")


def _turn_outward(mesh: trimesh.Trimesh) -> bool:
    """Make all faces counter-clockwise from outside; returns whether any was turned."""
    before = np.array(mesh.faces)
    if not mesh.is_winding_consistent or (mesh.is_watertight and _volume(mesh) < 0):
        with np.errstate(invalid="ignore", divide="ignore"):  # flat bodies have no centre of mass
            trimesh.repair.fix_normals(mesh, multibody=True)
    if not mesh.is_watertight and _winding(mesh)[0].sum() < 0:
        # The volume of an open mesh depends on the origin, so it cannot tell inside from outside.
        mesh.invert()
    return not np.array_equal(before, mesh.faces)


def _join(mesh: trimesh.Trimesh, notes: list[str]) -> trimesh.Trimesh:
    """The union of overlapping bodies; without it, overlaps count twice in the mass and hide surface inside."""
    if not mesh.is_watertight or mesh.body_count == 1:
        return mesh
    bodies = list(mesh.split(only_watertight=False))
    notes.append(f"{len(bodies)} separate bodies")
    if not all(_is_solid(body) for body in bodies):
        return mesh
    joined = trimesh.boolean.union(bodies, engine="manifold")
    if not _is_solid(joined) or _volume(joined) > (1 - OVERLAP) * _volume(mesh):
        return mesh
    notes[-1] = f"{len(bodies)} overlapping bodies were joined"
    return joined


def _volume(mesh: trimesh.Trimesh) -> float:
    """Signed volume [m^3]; trimesh's own divides by it to find the centre of mass."""
    return enclosed_volume(mesh.triangles)


def _is_solid(mesh: trimesh.Trimesh) -> bool:
    return mesh.is_watertight and mesh.is_winding_consistent and _volume(mesh) > 0


def _hull(mesh: trimesh.Trimesh) -> trimesh.Trimesh | None:
    try:
        with np.errstate(invalid="ignore", divide="ignore"):  # a flat one has no centre of mass
            return trimesh.convex.convex_hull(mesh)
    except QhullError:
        return None


def _winding(mesh: trimesh.Trimesh) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"], float]:
    """Winding numbers on a grid over the mesh's box, the grid's points [m], and the volume of a cell [m^3]."""
    import igl

    spacing = float(mesh.extents.max()) / 48  # probes along the longest side (ours)
    axes = [np.arange(low + spacing / 2, high, spacing) for low, high in mesh.bounds.T]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    winding = igl.fast_winding_number(
        np.ascontiguousarray(mesh.vertices, np.float64), np.ascontiguousarray(mesh.faces, np.int64), points)
    return np.asarray(winding), points, spacing**3


def _of_solid(body: trimesh.Trimesh) -> MassProperties:
    body = body.copy()
    body.density = 1.0
    return float(body.volume), np.asarray(body.center_mass), np.asarray(body.moment_inertia)


def _of_points(points: Float[np.ndarray, "n 3"], cell: float) -> MassProperties:
    """Mass properties of cubic cells of volume `cell` [m^3] around points [m]."""
    volume, centre = len(points) * cell, points.mean(0)
    second = (points - centre).T @ (points - centre) * cell + np.eye(3) * volume * cell ** (2 / 3) / 12
    return volume, centre, np.trace(second) * np.eye(3) - second
