"""Convex parts of a mesh: a simulator collides convex hulls only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from jaxtyping import Float, Int

from dro_grasp.errors import ObjectError
from dro_grasp.objects.cache import Arrays, cached_arrays
from dro_grasp.objects.repair import OPEN_FILL
from dro_grasp.objects.surface_distances import signed_distances

THRESHOLD = 0.08
"""CoACD's concavity threshold [1] (ours)."""
MAX_PARTS = 24
"""Most parts of one object (ours)."""
MAX_VERTICES = 64
"""Most vertices of one part (ours): collision cost grows with them."""
SEARCH = 60
"""CoACD's search iterations per cut (ours)."""
RESOLUTION = 1000
"""Points with which CoACD measures concavity (ours)."""
CONVEX = 0.97
"""Share of its hull that a mesh must fill to count as convex (ours)."""
CLOSING = 64
"""Cells along the longest side of the grid that closes a mesh with holes (ours)."""
CLOSED_FACES = 6000
"""Most faces of a closed mesh (ours)."""

Part = tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]
"""Vertices [m] and faces of a convex part."""


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
    if mesh.volume > CONVEX * hull.volume:
        return [(np.asarray(hull.vertices), np.asarray(hull.faces))]
    import coacd

    coacd.set_log_level("error")
    try:
        parts = coacd.run_coacd(
            coacd.Mesh(mesh.vertices, mesh.faces), threshold=THRESHOLD, max_convex_hull=MAX_PARTS,
            mcts_iterations=SEARCH, resolution=RESOLUTION, decimate=True, max_ch_vertex=MAX_VERTICES, seed=0,
        )
    except (RuntimeError, ValueError, MemoryError) as error:  # C++ errors, as its bindings translate them
        raise ObjectError(f"the mesh cannot be cut into convex parts ({error}); repair or simplify it") from error
    if not parts:
        raise ObjectError("the mesh cannot be cut into convex parts (CoACD found none); repair or simplify it")
    return [(np.asarray(v), np.asarray(f)) for v, f in parts]


def closed_surface(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> trimesh.Trimesh | None:
    """A watertight mesh around the points that are inside by their winding number; None if there are none."""
    import igl

    low, high = vertices.min(0), vertices.max(0)
    spacing = float((high - low).max()) / CLOSING
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
    if len(surface.faces) > CLOSED_FACES:
        surface = surface.simplify_quadric_decimation(face_count=CLOSED_FACES)
    trimesh.repair.fix_normals(surface)
    return surface


def pack(parts: Sequence[Part]) -> Arrays:
    """Parts as three arrays: all vertices, all faces, and the counts of each part."""
    return {
        "vertices": np.concatenate([v for v, _ in parts]), "faces": np.concatenate([f for _, f in parts]),
        "counts": np.array([(len(v), len(f)) for v, f in parts]),
    }


def unpack(stored: Arrays) -> tuple[Part, ...]:
    """The inverse of `pack`."""
    ends = np.cumsum(stored["counts"], axis=0)[:-1]
    vertices = np.split(stored["vertices"], ends[:, 0])
    faces = np.split(stored["faces"], ends[:, 1])
    return tuple(zip(vertices, faces, strict=True))
