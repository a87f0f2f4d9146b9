"""Convex parts of a mesh: a simulator collides convex hulls only."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, QhullError

from dro_grasp.errors import ObjectError
from dro_grasp.geometry.cache import Arrays, cached_arrays, content_hash, store_arrays, stored_arrays
from dro_grasp.geometry.mesh_files import trimesh
from dro_grasp.geometry.point_clouds import even_directions
from dro_grasp.objects.cutting import CutShortError, Part, cut_apart
from dro_grasp.objects.surface_distances import signed_distances

THRESHOLD = 0.08  # CoACD's concavity threshold [1] (ours)
MAX_PARTS = 24  # Most parts of one object (ours)
MAX_VERTICES = 64  # Most vertices of one part (ours): collision cost grows with them
OPEN_FILL = 0.05  # Share of its hull that a mesh with holes must fill (ours); a bent sheet appears to fill a little
COARSE_VERTICES = 48  # Most vertices of a coarse part. Ours: the surface of a ball then lies up to 9 % of its radius inside
COARSE_SHARE = 0.5  # Share of the parts that is left, rounded up (ours)

SECONDS = 30.0  # Computing time of CoACD [s] (ours): all runs together, so that one that is cut off is not begun anew
LEAST_SECONDS = 2.0  # What must be left of it to begin [s] (ours)
COARSER_SECONDS = 60.0  # Computing time of V-HACD [s] (ours); it takes 1 to 5
VOXELS = 100_000  # Cells of V-HACD (ours): a quarter of its own default, which takes four times as long
MAX_BODIES = 64  # Most bodies that each become a part (ours); of more, those that are near one another become one
CUT_BODIES = 8  # Most of them that are cut further (ours)
MAX_FACES = 30_000  # Most faces that are cut as they are (ours)
FEWER_FACES = 6_000  # Faces of the copy that is cut instead (ours)
CONVEX = 0.97  # Share of its hull that a body fills that counts as convex (ours)

Progress = Callable[[int, int], None]  # Called with (computing time, its limit) in whole seconds


class Cut(NamedTuple):
    """Convex parts, and what is to be said of them."""

    parts: tuple[Part, ...]
    note: str | None = None
    lasting: bool = True  # Whether another run would find no others


def decompose(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"], key: str, progress: Progress | None = None
) -> Cut:
    """Convex parts, cached under the content hash `key`; a convex mesh is its own part.

    They are CoACD's. Where that takes too long or fails, they are V-HACD's; where there are many bodies, each is one.
    """
    name = f"{key[:24]}-{THRESHOLD * 1000:.0f}-{MAX_PARTS}-{MAX_VERTICES}"
    for kind in ("parts", "coarser"):
        if (stored := stored_arrays(f"{kind}-{name}")) is not None:
            return Cut(unpack(stored), str(stored["note"]) if "note" in stored else None)
    cut = _run(vertices, faces, name, progress)
    # Parts of another kind have a key of their own: an earlier version, which knows no notes, goes on with CoACD's.
    kind, note = ("parts", {}) if cut.note is None else ("coarser", {"note": np.array(cut.note)})
    if cut.lasting:
        store_arrays(f"{kind}-{name}", pack(cut.parts) | note)
    return cut


def _run(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"], name: str, progress: Progress | None) -> Cut:
    """Close the mesh if necessary, and cut it unless it is convex."""
    hull = trimesh.convex.convex_hull(vertices)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if not mesh.is_volume:
        # CoACD would close such a mesh itself, but the result takes it ten times as long to cut.
        stored = cached_arrays(f"closed-{name}", lambda: _closed(vertices, faces))
        mesh = trimesh.Trimesh(stored["vertices"], stored["faces"], process=False)
        if not len(mesh.faces) or mesh.volume < OPEN_FILL * hull.volume:
            mesh = hull
    if mesh.volume > CONVEX * hull.volume:
        return Cut((as_part(hull),))
    if mesh.body_count > MAX_PARTS:
        return _by_body(mesh)
    return _by_coacd(mesh, name, progress)


def _closed(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> Arrays:
    """The closed surface around a mesh; without faces if there is none."""
    mesh = closed_surface(vertices, faces)
    empty = {"vertices": np.zeros((0, 3)), "faces": np.zeros((0, 3), int)}
    return empty if mesh is None else {"vertices": np.asarray(mesh.vertices), "faces": np.asarray(mesh.faces)}


def _by_coacd(mesh: trimesh.Trimesh, name: str, progress: Progress | None) -> Cut:
    """Parts by CoACD, as far as its time goes; else by V-HACD."""
    note, stored = None, stored_arrays(f"tried-{name}")
    before = 0.0 if stored is None else float(stored["seconds"])
    if (count := len(mesh.faces)) > MAX_FACES:
        mesh = mesh.simplify_quadric_decimation(face_count=FEWER_FACES)
        note = f"its convex parts are those of a copy with {len(mesh.faces)} of its {count} faces"

    def spent(seconds: float) -> None:
        store_arrays(f"tried-{name}", {"seconds": np.array(before + seconds)})
        if progress is not None:
            progress(int(before + seconds), int(SECONDS))

    if progress is not None:
        progress(int(before), int(SECONDS))
    if (left := SECONDS - before) < LEAST_SECONDS:
        return _by_vhacd(mesh, f"CoACD was not done after {SECONDS:g} s of computing")
    try:
        parts = cut_apart(
            "coacd", mesh, left, spent, threshold=THRESHOLD, max_convex_hull=MAX_PARTS, mcts_iterations=60, resolution=1000,
            decimate=True, max_ch_vertex=MAX_VERTICES, seed=0)
    except CutShortError as error:
        if error.over:
            spent(left)
        why = f"CoACD was not done after {SECONDS:g} s of computing" if error.over else f"CoACD failed ({error})"
        return _by_vhacd(mesh, why)._replace(lasting=not error.chance)
    return Cut(tuple(parts), note)


def _by_body(mesh: trimesh.Trimesh) -> Cut:
    """The hull of each body of many, or V-HACD's parts of the few whose hulls are worst; V-HACD's parts of very many."""
    bodies = [body for body in mesh.split(only_watertight=False) if len(body.vertices) > 3]
    if len(bodies) > 2 * MAX_BODIES:
        return _by_vhacd(mesh, f"it has {len(bodies)} bodies", most=MAX_BODIES)
    hulls = [trimesh.convex.convex_hull(body) for body in bodies]
    filled = sorted(range(len(bodies)), key=lambda i: bodies[i].volume - hulls[i].volume)[:CUT_BODIES]
    worst = [i for i in filled if bodies[i].volume < CONVEX * hulls[i].volume]
    parts = [as_part(hull) for i, hull in enumerate(hulls) if i not in worst]
    for i in worst:
        parts += _by_vhacd(bodies[i], "", most=max(1, 1 + (MAX_BODIES - len(bodies)) // CUT_BODIES)).parts
    note = f"each of its {len(bodies)} bodies is a convex part" if not worst else (
        f"the hulls of its {len(bodies)} bodies are its convex parts; {len(worst)} bodies were cut further, by V-HACD")
    if len(parts) > MAX_BODIES:
        parts, note = _joined(parts, MAX_BODIES), f"{note}; parts near one another were joined to {MAX_BODIES}"
    return Cut(tuple(parts), note)


def _by_vhacd(mesh: trimesh.Trimesh, why: str, most: int = MAX_PARTS) -> Cut:
    """Coarser parts, and the reason for them; an ObjectError if there are none either."""
    try:
        found = cut_apart(
            "vhacd", mesh, COARSER_SECONDS, lambda _: None, maxConvexHulls=most, resolution=VOXELS,
            maxNumVerticesPerCH=MAX_VERTICES, asyncACD=False)
        parts = [as_part(trimesh.convex.convex_hull(vertices)) for vertices, _ in found]
    except (CutShortError, QhullError) as error:
        raise ObjectError(f"the mesh cannot be cut into convex parts: {why}, and V-HACD failed ({error}); repair or simplify it"
                          ) from error
    return Cut(tuple(parts), f"its {len(parts)} convex parts are coarser, by V-HACD, because {why}")


def closed_surface(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> trimesh.Trimesh | None:
    """A watertight mesh around the points that are inside by their winding number; None if there are none."""
    import igl

    low, high = vertices.min(0), vertices.max(0)
    spacing = float((high - low).max()) / 64  # cells along the longest side (ours)
    counts = np.ceil((high - low) / spacing).astype(int) + 5
    axes = [low[i] + spacing * (np.arange(counts[i]) - 2) for i in range(3)]
    # In libigl's grids the first axis is the fastest.
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).transpose(2, 1, 0, 3).reshape(-1, 3)
    distance = signed_distances(vertices, faces, points)
    if distance.min() >= 0:
        return None
    nx, ny, nz = (int(n) for n in counts)
    corners, triangles = igl.marching_cubes(distance, points, nx, ny, nz, 0.0)[:2]
    surface = trimesh.Trimesh(corners, triangles)
    if len(surface.faces) > (most := 6000):  # (ours)
        surface = surface.simplify_quadric_decimation(face_count=most)
    trimesh.repair.fix_normals(surface)
    return surface


def as_part(mesh: trimesh.Trimesh) -> Part:
    """A convex mesh as a part."""
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def pack(parts: Sequence[Part]) -> Arrays:
    """Parts as three arrays: all vertices, all faces, and the counts of each part."""
    vertices, faces = zip(*parts, strict=True)
    return {"vertices": np.concatenate(vertices), "faces": np.concatenate(faces),
            "counts": np.array([(len(v), len(f)) for v, f in parts])}


def unpack(stored: Arrays) -> tuple[Part, ...]:
    """The inverse of `pack`."""
    ends = np.cumsum(stored["counts"], axis=0)[:-1]
    pieces = (np.split(stored[name], ends[:, k]) for k, name in enumerate(("vertices", "faces")))
    return tuple(zip(*pieces, strict=True))


def coarse_parts(parts: Sequence[Part]) -> tuple[Part, ...]:
    """Half as many parts: those whose common hull adds the least volume are joined, pair by pair; each is then simplified."""
    # A part keeps the vertices that are outermost in evenly spread directions, so thin parts stay solid. Cached.
    key = content_hash(*(array for part in parts for array in part))
    settings = f"{COARSE_VERTICES}-{COARSE_SHARE * 100:.0f}"
    left = len(parts) - int((1 - COARSE_SHARE) * len(parts))
    stored = cached_arrays(f"coarse-{key[:24]}-{settings}", lambda: pack(_joined(parts, left)))
    return unpack(stored)


def _joined(parts: Sequence[Part], left: int) -> list[Part]:
    """So many parts as are to be left."""
    vertices = {i: _outermost(np.asarray(v, np.float64)) for i, (v, _) in enumerate(parts)}
    volume = {i: float(ConvexHull(v).volume) for i, v in vertices.items()}

    def added(i: int, j: int) -> float:
        return float(ConvexHull(np.concatenate([vertices[i], vertices[j]])).volume) - volume[i] - volume[j]

    price = {pair: added(*pair) for pair in combinations(vertices, 2)}
    for new in range(len(parts), 2 * len(parts) - left):
        pair = min(price, key=price.__getitem__)
        price = {other: p for other, p in price.items() if not set(pair) & set(other)}
        both = np.concatenate([vertices.pop(i) for i in pair])
        vertices[new], volume[new] = _outermost(both), float(ConvexHull(both).volume)
        price |= {(i, new): added(i, new) for i in vertices if i != new}
    return [as_part(trimesh.convex.convex_hull(v)) for v in vertices.values()]


def _outermost(vertices: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "_ 3"]:
    """The vertices that are farthest in each of the directions, of the part stretched to a cube."""
    cube = vertices / np.ptp(vertices, axis=0)
    return vertices[np.unique((cube @ even_directions(COARSE_VERTICES).T.numpy()).argmax(0))]
