"""Convex parts of a mesh, because a simulator collides convex hulls only."""

from __future__ import annotations

import numpy as np

from dro_grasp.objects.cache import cached_arrays
from dro_grasp.objects.shape import Part

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


def decompose(vertices: np.ndarray, faces: np.ndarray, key: str) -> tuple[Part, ...]:
    """Convex parts by CoACD, cached under the content hash `key`; a convex mesh is its own part."""
    settings = f"{THRESHOLD * 1000:.0f}-{MAX_PARTS}-{MAX_VERTICES}"
    stored = cached_arrays(f"parts-{key[:24]}-{settings}", lambda: _pack(_run(vertices, faces)))
    return _unpack(stored)


def _run(vertices: np.ndarray, faces: np.ndarray) -> list[Part]:
    import trimesh

    hull = trimesh.convex.convex_hull(vertices)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if mesh.is_watertight and mesh.volume > CONVEX * hull.volume:
        return [(np.asarray(hull.vertices), np.asarray(hull.faces))]
    import coacd

    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(vertices, faces), threshold=THRESHOLD, max_convex_hull=MAX_PARTS, mcts_iterations=SEARCH,
        resolution=RESOLUTION, decimate=True, max_ch_vertex=MAX_VERTICES, seed=0,
    )
    return [(np.asarray(v), np.asarray(f)) for v, f in parts]


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
