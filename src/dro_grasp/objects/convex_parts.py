"""Convex parts of a mesh, because a simulator collides convex hulls only."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dro_grasp.errors import ObjectError
from dro_grasp.objects.cache import cached_arrays
from dro_grasp.objects.repair import OPEN_FILL
from dro_grasp.objects.shape import Part, signed_distances

if TYPE_CHECKING:
    import trimesh

THRESHOLD = 0.08
"""CoACD's concavity threshold."""
MAX_PARTS = 24
"""Most parts of one object."""
MAX_VERTICES = 64
"""Most vertices of one part: collision cost grows with them."""
SEARCH, RESOLUTION = 60, 1000
"""CoACD's search iterations per cut, and points by which it measures concavity."""
CONVEX = 0.97
"""Share of its hull that a mesh fills to count as convex."""
CLOSING, CLOSED_FACES = 64, 6000
"""Cells along the longest side for closing a mesh with holes, and most faces of the closed one."""


def decompose(vertices: np.ndarray, faces: np.ndarray, key: str) -> tuple[Part, ...]:
    """Convex parts by CoACD, cached under the content hash `key`; a convex mesh is its own part."""
    settings = f"{THRESHOLD * 1000:.0f}-{MAX_PARTS}-{MAX_VERTICES}"
    stored = cached_arrays(f"parts-{key[:24]}-{settings}", lambda: _pack(_run(vertices, faces)))
    return _unpack(stored)


def _run(vertices: np.ndarray, faces: np.ndarray) -> list[Part]:
    import trimesh

    hull = trimesh.convex.convex_hull(vertices)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if not mesh.is_volume:
        # CoACD closes such a mesh itself, and then takes ten times as long over what it has made.
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
    except Exception as error:  # the library's bindings raise what they like
        raise ObjectError(f"the mesh cannot be cut into convex parts ({error}); repair or simplify it") from error
    if not parts:
        raise ObjectError("the mesh cannot be cut into convex parts (CoACD found none); repair or simplify it")
    return [(np.asarray(v), np.asarray(f)) for v, f in parts]


def closed_surface(vertices: np.ndarray, faces: np.ndarray) -> trimesh.Trimesh | None:
    """A watertight mesh around what the winding number calls inside; None where that is nothing."""
    import igl
    import trimesh

    low, high = vertices.min(0), vertices.max(0)
    spacing = float((high - low).max()) / CLOSING
    counts = np.ceil((high - low) / spacing).astype(int) + 5
    axes = [low[i] + spacing * (np.arange(counts[i]) - 2) for i in range(3)]
    # libigl wants the first axis to run fastest.
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


def _pack(parts: list[Part]) -> dict[str, np.ndarray]:
    return {
        "vertices": np.concatenate([v for v, _ in parts]), "faces": np.concatenate([f for _, f in parts]),
        "counts": np.array([(len(v), len(f)) for v, f in parts]),
    }


def _unpack(stored: dict[str, np.ndarray]) -> tuple[Part, ...]:
    ends = np.cumsum(stored["counts"], axis=0)[:-1]
    vertices = np.split(stored["vertices"], ends[:, 0])
    faces = np.split(stored["faces"], ends[:, 1])
    return tuple(zip(vertices, faces, strict=True))
