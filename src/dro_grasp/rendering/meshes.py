"""Triangle meshes of one colour, and the marks that pictures need: arrows and dots."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Num

Colour = tuple[float, float, float]
"""Red, green, blue between 0 and 1."""
OBJECT_COLOUR: Colour = (0.95, 0.62, 0.28)
"""Orange of objects that are grasped."""


@dataclass(frozen=True)
class Mesh:
    """Triangles of one colour."""

    vertices: Num[np.ndarray, "n 3"]
    """World coordinates [m]."""
    faces: Int[np.ndarray, "m 3"]
    """Vertex indices."""
    colour: Colour
    """Before shading."""


def arrow(
    start: Num[np.ndarray, "3"], end: Num[np.ndarray, "3"], colour: Colour, radius: float = 0.002, sides: int = 12
) -> Mesh:
    """A shaft with a head, from `start` to `end` [m]."""
    along = np.asarray(end, float) - np.asarray(start, float)
    length = float(np.linalg.norm(along))
    head = min(5 * radius, 0.5 * length)
    profile = [(0, 0.0), (0, radius), (length - head, radius), (length - head, 2.5 * radius), (length, 0.0)]
    forward = along / max(length, 1e-12)
    side = unit(np.cross(forward, np.eye(3)[np.abs(forward).argmin()]))
    other = np.cross(forward, side)
    angles = np.arange(sides) * 2 * np.pi / sides
    ring = np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * other
    vertices = np.concatenate([np.asarray(start) + z * forward + r * ring for z, r in profile])
    i = np.arange(sides)
    j = (i + 1) % sides
    # Two triangles per side between each ring of the profile and the next.
    quads = [np.stack([[a * sides + i, a * sides + j, a * sides + j + sides],
                       [a * sides + i, a * sides + j + sides, a * sides + i + sides]]).transpose(0, 2, 1).reshape(-1, 3)
             for a in range(len(profile) - 1)]
    return Mesh(vertices, np.concatenate(quads), colour)


def dots(points: Num[np.ndarray, "n 3"], colour: Colour, radius: float = 0.0015) -> Mesh:
    """Small octahedra at points [m]."""
    corners = np.concatenate([np.eye(3), -np.eye(3)]) * radius
    one = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
    vertices = (np.asarray(points, float)[:, None] + corners).reshape(-1, 3)
    return Mesh(vertices, (one + 6 * np.arange(len(points))[:, None, None]).reshape(-1, 3), colour)


def corner_normals(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"], crease: float
) -> Float[np.ndarray, "m 3 3"]:
    """Unit normals at the corners of each face: smooth, but flat where the surface folds.

    Args:
        crease: Cosine between face normal and vertex normal below which the corner takes the face normal.
    """
    triangle = vertices[faces]
    face = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
    # Files repeat a vertex for every face that uses it: vertices at the same place share their normal.
    _, place = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)
    place = place.reshape(-1)
    total = np.zeros((place.max(initial=-1) + 1, 3))
    for k in range(3):
        np.add.at(total, place[faces[:, k]], face)
    flat = face / np.maximum(np.linalg.norm(face, axis=1, keepdims=True), 1e-20)
    smooth = total[place[faces]]
    smooth = smooth / np.maximum(np.linalg.norm(smooth, axis=2, keepdims=True), 1e-20)
    sharp = (smooth * flat[:, None]).sum(2, keepdims=True) < crease
    return np.where(sharp, flat[:, None], smooth)


def unit(v: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """The vector at length 1; zero stays zero."""
    return v / max(float(np.linalg.norm(v)), 1e-12)
