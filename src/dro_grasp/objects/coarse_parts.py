"""Convex parts of another resolution: fewer, with fewer vertices, from the ones that an object has."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from dro_grasp.geometry.point_clouds import even_directions
from dro_grasp.objects.cache import cached_arrays, content_hash
from dro_grasp.objects.convex_parts import Part, pack, unpack

COARSE_VERTICES = 48
"""Most vertices of a coarse part. Ours: the surface of a ball then lies up to 9 % of its radius inside."""
COARSE_SHARE = 0.5
"""Share of the parts that is left, rounded up (ours)."""


def coarse_parts(parts: Sequence[Part]) -> tuple[Part, ...]:
    """Half as many parts: those whose common hull adds the least volume are joined, pair by pair; each is then simplified.

    A part keeps the vertices that are outermost in evenly spread directions, so thin parts stay solid. Cached.
    """
    key = content_hash(*(array for part in parts for array in part))
    settings = f"{COARSE_VERTICES}-{COARSE_SHARE * 100:.0f}"
    stored = cached_arrays(f"coarse-{key[:24]}-{settings}", lambda: pack([_hull(v) for v in _joined(parts)]))
    return unpack(stored)


def _joined(parts: Sequence[Part]) -> list[Float[np.ndarray, "_ 3"]]:
    """Vertices of the joined parts."""
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
    return list(vertices.values())


def _outermost(vertices: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "_ 3"]:
    """The vertices that are farthest in each of the directions, of the part stretched to a cube."""
    cube = vertices / np.ptp(vertices, axis=0)
    return vertices[np.unique((cube @ even_directions(COARSE_VERTICES).T.numpy()).argmax(0))]


def _hull(vertices: Float[np.ndarray, "n 3"]) -> Part:
    """The convex hull with outward faces."""
    import trimesh

    hull = trimesh.convex.convex_hull(vertices)
    return np.asarray(hull.vertices), np.asarray(hull.faces)
