"""Meshes as files have them made solid, as far as that is safe, each change reported in a note; and their mass properties."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import QhullError

from dro_grasp.errors import ObjectError, UngraspableError
from dro_grasp.geometry.mesh_files import trimesh
from dro_grasp.geometry.point_clouds import enclosed_volume
from dro_grasp.objects.convex_parts import OPEN_FILL
from dro_grasp.objects.polygons import close_small_holes, unfold

LEAST_FILL = 1e-3
"""Share of its bounding box that a hull must fill, and share of its hull that a closed mesh must fill (ours); less is a
sheet."""
BORDER = 0.4
"""Share of the length of all edges from which on those of one face alone make a mesh open (ours): a box without its lid has
0.2, a tube 0.45, two triangles 0.8."""
INSIDE = 0.75  # Winding number from which on a place is surely inside a mesh [1] (ours)
OUTSIDE = 0.25  # Winding number up to which a place is surely outside [1] (ours)
ENCLOSED = (0.2, 0.8)
"""What an open mesh encloses (ours): places surely inside, over those not surely outside, and places more inside than
outside, over its convex hull. With less than both it is a sheet: two sides of a box have 0 and 0.4, a tray has 0.05 and 1."""
WIDE = 0.05
"""Share of a mesh's area from which on what it leaves open is no small hole (ours): half a ball has 0.5, a cup 0.17, a glass
0.1, a bottle 0.02."""
AS_SOLID = ("not watertight: its opening counts as closed, so it is solid here; if it is hollow, as a bowl or cup is, give its "
            "wall a thickness")
"""What to say of a mesh with a wide opening."""
FAR_APART = 0.005  # Gap between bodies of one mesh from which on they look like several things [m] (ours)
MOST_LINKED = 1000  # Bodies of one mesh beyond which no gaps between them are looked for (ours)
OVERLAP = 1e-3  # Share of the volume by which bodies may overlap without being joined (ours)

MassProperties = tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]
"""Volume [m^3], centre of mass [m], and inertia about it at unit density [m^5]."""


def check_surface(mesh: trimesh.Trimesh, origin: str) -> None:
    """Refuse faces without area, soups of faces, and open sheets of few faces, by an ObjectError."""
    if not (len(mesh.faces) and mesh.nondegenerate_faces().any()):
        raise ObjectError(f"{origin} has {len(mesh.faces)} faces, none of which has an area; give a triangle mesh of a solid")
    edges = mesh.faces_unique_edges[mesh.unique_faces()]  # a face and its reverse side count once
    alone = float((np.unique(edges, return_counts=True)[1] == 1).mean())
    if len(mesh.faces) > 100 and alone > 0.9:  # (ours) their inside takes minutes to tell
        raise ObjectError(f"{origin} is no surface: {alone:.0%} of the edges of its {len(mesh.faces)} faces belong to one face "
                          "alone; join the faces (merge vertices), or give a point cloud of the surface")
    if (border := _border(mesh)) > BORDER and _is_sheet(_wound(mesh)):
        raise UngraspableError(f"{origin} is an open sheet and encloses nothing: {border:.0%} of the length of the edges of "
                               f"its {len(mesh.faces)} faces belongs to one face alone",
                               "; close it, give it a thickness, or give a point cloud of the surface")


def _border(mesh: trimesh.Trimesh) -> float:
    """Share of the length of all edges that belongs to one face alone [1]; a face and its reverse side count once."""
    faces = np.bincount(mesh.faces_unique_edges[mesh.unique_faces()].ravel(), minlength=len(mesh.edges_unique_length))
    return float(mesh.edges_unique_length[faces == 1].sum() / max(mesh.edges_unique_length.sum(), 1e-12))


def _wound(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A copy of an open mesh without repeated faces and reverses, in which neighbours are wound alike; no hole is closed."""
    mesh = mesh.copy()
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    mesh.remove_unreferenced_vertices()
    trimesh.repair.fix_winding(mesh)
    return mesh


def _is_sheet(mesh: trimesh.Trimesh) -> bool:
    """Whether an open mesh encloses next to nothing; flat ones, which have no hull, are refused later."""
    if (hull := _hull(mesh)) is None or hull.volume < LEAST_FILL * float(np.prod(mesh.extents)):
        return False
    return not (mesh.is_watertight or _encloses(mesh, hull.volume) or _encloses(_spread(mesh), hull.volume))


def _encloses(mesh: trimesh.Trimesh, hull: float) -> bool:
    """Whether an open mesh has an inside, by winding numbers; `hull` is the volume of its convex hull [m^3]."""
    winding, _, cell = _winding(mesh)
    inside, more, maybe = (int((np.abs(winding) > least).sum()) for least in (INSIDE, 0.5, OUTSIDE))
    return bool(inside >= ENCLOSED[0] * maybe or more * cell >= ENCLOSED[1] * hull)


def _spread(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A copy of which each connected piece faces away from the middle: the winding of faces that meet no other is unknown."""
    faces, apart = np.array(mesh.faces), np.asarray(mesh.triangles) - np.asarray(mesh.bounds).mean(0)
    volumes = np.linalg.det(apart)  # that each face spans with the middle, six times
    for piece in trimesh.graph.connected_components(mesh.face_adjacency, nodes=np.arange(len(faces)), min_len=1):
        if volumes[piece].sum() < 0:
            faces[piece] = faces[piece][:, ::-1]
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def repair(mesh: trimesh.Trimesh, notes: list[str]) -> trimesh.Trimesh:
    """Decimate, close, turn outward and join a mesh with merged vertices, as far as that is safe; `notes` gets each finding."""
    if (before := len(mesh.faces)) > 100_000:  # (ours)
        mesh = mesh.simplify_quadric_decimation(face_count=50_000)
        notes.append(f"decimated from {before} to {len(mesh.faces)} faces")
    if folded := unfold(mesh):
        notes.append(f"{folded} faces with a notch, which were cut into triangles across it, were cut within their outline")
    mixed = not mesh.is_winding_consistent
    own, closed = (len(mesh.faces), "") if mesh.is_watertight else _close(mesh)
    turned = _turn_outward(mesh, mixed) or mixed
    if closed:
        notes.append(AS_SOLID if _opening(mesh.triangles[:own]) > WIDE else closed)
    if turned:
        notes.append("faces were turned outward")
    return _join(mesh, notes)


def mass_properties(mesh: trimesh.Trimesh, origin: str, notes: list[str]) -> MassProperties:
    """Volume, centre of mass and inertia; an ObjectError if not even the convex hull encloses a volume."""
    # A mesh with holes is measured by the points inside by their winding number, a sheet by its convex hull.
    hull = _hull(mesh)
    box = float(np.prod(mesh.extents))
    if hull is None or hull.volume < max(LEAST_FILL * box, 1e-9):  # [m^3] (ours)
        raise UngraspableError(f"{origin} encloses no volume (extents {np.round(mesh.extents * 1000, 2).tolist()} mm)",
                               "; give a closed solid, or a point cloud if only its surface is known")
    if _is_solid(mesh) and LEAST_FILL * hull.volume < _volume(mesh) <= (1 + OVERLAP) * hull.volume:
        return _of_solid(mesh)
    winding, points, cell = _winding(mesh)
    inside = points[np.abs(winding) > 0.5]
    if len(inside) * cell > max(OPEN_FILL * hull.volume, 100 * cell):
        return _of_points(inside, cell)
    notes.append("volume and mass are those of the convex hull, because the mesh encloses none")
    return _of_solid(hull)


def _close(mesh: trimesh.Trimesh) -> tuple[int, str]:
    """Close small holes, in place, by faces after its own; returns how many are its own, and what to say."""
    before = len(mesh.faces)
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    mesh.remove_unreferenced_vertices()
    own = len(mesh.faces)
    if mesh.is_watertight:
        return own, f"{before - own} repeated faces or faces without area were left out"
    trimesh.repair.fill_holes(mesh)  # of three or four edges
    if not mesh.is_watertight:
        if not mesh.is_winding_consistent:
            trimesh.repair.fix_winding(mesh)
        close_small_holes(mesh, WIDE)
    return own, "holes were closed" if mesh.is_watertight else (
        "not watertight: distances use winding numbers, which cope with small holes")


def _opening(triangles: Float[np.ndarray, "n 3 3"]) -> float:
    """Area of what faces that are wound alike leave open to one side, as a share of theirs [1]: of a closed surface none."""
    areas = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return float(np.linalg.norm(areas.sum(0)) / np.linalg.norm(areas, axis=1).sum())


def _turn_outward(mesh: trimesh.Trimesh, mixed: bool) -> bool:
    """Make all faces counter-clockwise from outside, of pieces wound at random if `mixed`; returns whether any was turned."""
    before = np.array(mesh.faces)
    _turn_bodies(mesh)
    if mixed or not mesh.is_winding_consistent or (mesh.is_watertight and _volume(mesh) < 0):
        with np.errstate(invalid="ignore", divide="ignore"):  # flat bodies have no centre of mass
            trimesh.repair.fix_normals(mesh, multibody=True)
    if not mesh.is_watertight and _winding(mesh)[0].sum() < 0:
        # The volume of an open mesh depends on the origin, so it cannot tell inside from outside.
        mesh.invert()
    return not np.array_equal(before, mesh.faces)


def _turn_bodies(mesh: trimesh.Trimesh) -> None:
    """Turn inverted bodies that are no cavities of others: their volume would count against that of the others."""
    import igl

    if not (mesh.is_watertight and mesh.is_winding_consistent and mesh.body_count > 1):
        return
    if _volume(mesh) < 0:  # as a whole: cavities then stay what they are
        mesh.invert()
    faces, vertices = np.array(mesh.faces, np.int64), np.ascontiguousarray(mesh.vertices, np.float64)
    bodies = trimesh.graph.connected_components(mesh.face_adjacency, nodes=np.arange(len(faces)), min_len=1)
    boxes = np.array([_box(mesh.triangles[body]) for body in bodies])
    for body, box in zip(bodies, boxes, strict=True):
        if enclosed_volume(mesh.triangles[body]) < 0:
            around = [other for other, outer in zip(bodies, boxes, strict=True)
                      if other is not body and (outer[0] <= box[0]).all() and (box[1] <= outer[1]).all()]
            winding = igl.fast_winding_number(vertices, np.ascontiguousarray(faces[np.concatenate(around)]),
                                              vertices[np.unique(faces[body])]) if around else np.zeros(1)
            if float(np.abs(winding).mean()) < 0.5:
                faces[body] = faces[body][:, ::-1]
    if not np.array_equal(faces, mesh.faces):
        mesh.faces = faces


def _box(triangles: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "2 3"]:
    """Lower and upper corner."""
    return np.stack([triangles.min((0, 1)), triangles.max((0, 1))])


def _join(mesh: trimesh.Trimesh, notes: list[str]) -> trimesh.Trimesh:
    """The union of overlapping bodies; without it, overlaps count twice in the mass and hide surface inside."""
    if not mesh.is_watertight or mesh.body_count == 1:
        return mesh
    bodies = list(mesh.split(only_watertight=False))
    apart = _apart(np.array([body.bounds for body in bodies])) if len(bodies) <= MOST_LINKED else 0.0
    notes.append(f"{len(bodies)} separate bodies" + ("" if apart < FAR_APART else (
        f", up to {apart * 100:.2g} cm apart, count as one rigid object; if they are several things, give each its own file")))
    if not all(_is_solid(body) for body in bodies):
        return mesh
    joined = trimesh.boolean.union(bodies, engine="manifold")
    if not _is_solid(joined) or _volume(joined) > (1 - OVERLAP) * _volume(mesh):
        return mesh
    notes[-1] = f"{len(bodies)} overlapping bodies were joined"
    return joined


def _apart(boxes: Float[np.ndarray, "n 2 3"]) -> float:
    """The widest gap [m] on the shortest ways that link all boxes, each of which has a lower and an upper corner."""
    gaps = np.maximum(boxes[:, None, 0] - boxes[None, :, 1], boxes[None, :, 0] - boxes[:, None, 1]).clip(0)
    # Without an entry two bodies are not linked, and bodies that touch are.
    return float(minimum_spanning_tree(np.linalg.norm(gaps, axis=-1) + 1e-9).data.max(initial=0))


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
