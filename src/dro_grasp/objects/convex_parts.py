"""Convex parts of a mesh: a simulator collides convex hulls only."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull

from dro_grasp.errors import ObjectError
from dro_grasp.geometry.point_clouds import even_directions
from dro_grasp.objects.cache import Arrays, cached_arrays, content_hash
from dro_grasp.objects.surface_distances import signed_distances

THRESHOLD = 0.08  # CoACD's concavity threshold [1] (ours)
MAX_PARTS = 24  # Most parts of one object (ours)
MAX_VERTICES = 64  # Most vertices of one part (ours): collision cost grows with them
OPEN_FILL = 0.05  # Share of its hull that a mesh with holes must fill (ours); a bent sheet appears to fill a little
COARSE_VERTICES = 48  # Most vertices of a coarse part. Ours: the surface of a ball then lies up to 9 % of its radius inside
COARSE_SHARE = 0.5  # Share of the parts that is left, rounded up (ours)

Part = tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]  # Vertices [m] and faces of a convex part


def decompose(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"], key: str) -> tuple[Part, ...]:
    """Convex parts by CoACD, cached under the content hash `key`; a convex mesh is its own part."""
    settings = f"{THRESHOLD * 1000:.0f}-{MAX_PARTS}-{MAX_VERTICES}"
    stored = cached_arrays(f"parts-{key[:24]}-{settings}", lambda: pack(_run(vertices, faces)))
    return unpack(stored)


def _run(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> list[Part]:
    """Close the mesh if necessary, and cut it unless it is convex."""
    hull = trimesh.convex.convex_hull(vertices)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if not mesh.is_volume:
        # CoACD would close such a mesh itself, but the result takes it ten times as long to cut.
        mesh = closed_surface(vertices, faces)
        if mesh is None or mesh.volume < OPEN_FILL * hull.volume:
            mesh = hull
    if mesh.volume > 0.97 * hull.volume:  # it counts as convex (ours)
        return [as_part(hull)]
    import coacd

    coacd.set_log_level("error")
    try:
        parts = coacd.run_coacd(
            coacd.Mesh(mesh.vertices, mesh.faces), threshold=THRESHOLD, max_convex_hull=MAX_PARTS,
            mcts_iterations=60, resolution=1000, decimate=True, max_ch_vertex=MAX_VERTICES, seed=0)
    except (RuntimeError, ValueError, MemoryError) as error:  # C++ errors, as its bindings translate them
        raise ObjectError(f"the mesh cannot be cut into convex parts ({error}); repair or simplify it") from error
    if not parts:
        raise ObjectError("the mesh cannot be cut into convex parts (CoACD found none); repair or simplify it")
    return [(np.asarray(v), np.asarray(f)) for v, f in parts]


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
    stored = cached_arrays(f"coarse-{key[:24]}-{settings}", lambda: pack(_joined(parts)))
    return unpack(stored)


def _joined(parts: Sequence[Part]) -> list[Part]:
    vertices = {i: _outermost(np.asarray(v, np.float64)) for i, (v, _) in enumerate(parts)}
    volume = {i: float(ConvexHull(v).volume) for i, v in vertices.items()}

    def added(i: int, j: int) -> float:
        return float(ConvexHull(np.concatenate([vertices[i], vertices[j]])).volume) - volume[i] - volume[j]

    price = {pair: added(*pair) for pair in combinations(vertices, 2)}
    for new in range(len(parts), len(parts) + int((1 - COARSE_SHARE) * len(parts))):
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
