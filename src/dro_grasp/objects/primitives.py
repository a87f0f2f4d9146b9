"""Building blocks of the built-in objects: convex hulls of points, and hollow or bent solids of convex parts."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import trimesh
from jaxtyping import Float

Point = tuple[float, float, float]  # Coordinates [m]


@dataclass(frozen=True)
class Solid:
    """A solid that is not convex, and the convex parts that fill it.

    The surface is made directly, not as a union: parts that only touch leave cracks in their union.
    """

    mesh: trimesh.Trimesh
    parts: list[trimesh.Trimesh]

    def moved(self, by: Point) -> Solid:
        """The same solid elsewhere [m]."""
        mesh, *parts = (each.copy().apply_translation(by) for each in (self.mesh, *self.parts))
        return Solid(mesh, parts)


def hull(points: Float[np.ndarray, "n 3"]) -> trimesh.Trimesh:
    """Convex hull of points [m]."""
    mesh = trimesh.convex.convex_hull(points)
    if mesh.is_watertight and mesh.is_convex:
        return mesh
    # Points that nearly coincide, for example at the pole of a superquadric, leave slivers: merge those within a micrometre.
    first = np.unique(np.round(points / 1e-6), axis=0, return_index=True)[1]
    return trimesh.convex.convex_hull(points[first])


def box(size: Point, at: Point = (0, 0, 0)) -> trimesh.Trimesh:
    """A box of full size [m] at a place."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size
    return hull(corners + at)


def frustum(
    radii: tuple[float, float], heights: tuple[float, float], at: Point = (0, 0, 0), axis: str = "z", corners: int = 24
) -> trimesh.Trimesh:
    """A cone frustum between two heights along an axis [m]; equal radii make a cylinder."""
    angle = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], 1)
    points = np.concatenate([
        np.column_stack([max(r, 1e-4) * ring, np.full(corners, h)]) for r, h in zip(radii, heights, strict=True)
    ])
    return hull(_along(points, axis) + at)


def superquadric(size: Point, exponents: tuple[float, float], at: Point = (0, 0, 0)) -> trimesh.Trimesh:
    """A convex superquadric: half axes [m], and exponents: 1 makes an ellipsoid, near 0 a box, 2 an octahedron."""

    def power(values: Float[np.ndarray, "..."], exponent: float) -> Float[np.ndarray, "..."]:
        return np.sign(values) * np.abs(values) ** exponent

    latitude, longitude = np.meshgrid(np.linspace(-np.pi / 2, np.pi / 2, 17), np.linspace(-np.pi, np.pi, 33)[:-1])
    e1, e2 = exponents
    points = np.stack([
        power(np.cos(latitude), e1) * power(np.cos(longitude), e2),
        power(np.cos(latitude), e1) * power(np.sin(longitude), e2),
        power(np.sin(latitude), e1),
    ], -1).reshape(-1, 3)
    return hull(points * size + at)


def turned(profile: list[tuple[float, float]]) -> list[trimesh.Trimesh]:
    """A solid of revolution about z from (radius, height) pairs, bottom to top: one frustum a step [m]."""
    return [frustum((a[0], b[0]), (a[1], b[1])) for a, b in pairwise(profile)]


def hollow(profile: list[tuple[float, float]], wall: float, floor: float, corners: int = 16) -> Solid:
    """A vessel of revolution, open at the top [m].

    Args:
        profile: (radius, height) pairs of the outside, bottom to top; the floor lies below the second.
        wall: Thickness of the wall, measured level.
    """
    (low, bottom), (wide, above) = profile[:2]
    level = bottom + floor
    outer_at_level = low + (wide - low) * floor / (above - bottom)
    if not low - 1e-9 <= outer_at_level <= low + wall:
        raise ValueError("the floor must meet the wall: the profile may widen by at most the wall over the floor")
    base = frustum((low, low), (bottom, level), corners=corners)
    edges = np.linspace(0, 2 * np.pi, corners + 1)
    parts = [base] + [
        hull(np.array([(r * np.cos(t), r * np.sin(t), h)
                       for r, h in ((r0, h0), (r0 - wall, h0), (r1, h1), (r1 - wall, h1)) for t in (a, b)]))
        for (r0, h0), (r1, h1) in pairwise(profile) for a, b in pairwise(edges)
    ]
    inside = [(outer_at_level - wall, level), *((r - wall, h) for r, h in profile[1:])]
    return Solid(_revolved([(0.0, bottom), *profile, *inside[::-1], (0.0, level)], corners), parts)


def ring(radius: float, thickness: float, corners: int = 16, arc: float = 2 * np.pi, axis: str = "z",
         at: Point = (0, 0, 0), start: float = 0.0) -> Solid:
    """A torus, or an arc of one, from convex segments: radius of the middle line and of the tube [m]."""
    closed = bool(np.isclose(arc, 2 * np.pi))
    angles = np.linspace(start, start + arc, corners + 1)[: corners if closed else None]
    tube = np.linspace(0, 2 * np.pi, 10, endpoint=False)
    loops = [
        _along(np.array([((radius + thickness * np.cos(t)) * np.cos(s), (radius + thickness * np.cos(t)) * np.sin(s),
                          thickness * np.sin(t)) for t in tube]), axis) + at
        for s in angles
    ]
    segments = list(pairwise([*loops, loops[0]] if closed else loops))
    return Solid(_swept(loops, closed), [hull(np.concatenate(pair)) for pair in segments])


def tilted(part: trimesh.Trimesh, angle: float) -> trimesh.Trimesh:
    """A part turned about the y axis [rad]."""
    T = trimesh.transformations.rotation_matrix(angle, [0, 1, 0])
    return hull(trimesh.transform_points(part.vertices, T))


def _revolved(outline: list[tuple[float, float]], corners: int) -> trimesh.Trimesh:
    """Surface of revolution about z of (radius, height) pairs that begin and end on the axis."""
    angles = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    middle = [np.array([(r * np.cos(t), r * np.sin(t), h) for t in angles]) for r, h in outline[1:-1]]
    ends = np.array([(0.0, 0.0, h) for _, h in (outline[0], outline[-1])])
    return _outward(np.concatenate([*middle, ends]), _bands(len(middle), corners, closed=False)
                    + _fan(0, corners, corners * len(middle))
                    + _fan(corners * (len(middle) - 1), corners, corners * len(middle) + 1))


def _swept(loops: list[Float[np.ndarray, "corners 3"]], closed: bool) -> trimesh.Trimesh:
    """Surface through loops of equally many points, closed upon itself or capped at both ends."""
    count, corners = len(loops), len(loops[0])
    faces = _bands(count, corners, closed)
    points = np.concatenate(loops)
    if not closed:
        faces += _fan(0, corners, len(points)) + _fan(corners * (count - 1), corners, len(points) + 1)
        points = np.concatenate([points, loops[0].mean(0, keepdims=True), loops[-1].mean(0, keepdims=True)])
    return _outward(points, faces)


def _bands(loops: int, corners: int, closed: bool) -> list[tuple[int, int, int]]:
    """Triangles between each loop and the next."""
    faces = []
    for i in range(loops if closed else loops - 1):
        for j in range(corners):
            a, b = i * corners + j, i * corners + (j + 1) % corners
            c, d = (a + corners) % (loops * corners), (b + corners) % (loops * corners)
            faces += [(a, b, d), (a, d, c)]
    return faces


def _fan(first: int, corners: int, centre: int) -> list[tuple[int, int, int]]:
    """Triangles from a loop to a point."""
    return [(first + j, first + (j + 1) % corners, centre) for j in range(corners)]


def _outward(points: Float[np.ndarray, "n 3"], faces: list[tuple[int, int, int]]) -> trimesh.Trimesh:
    """A mesh with all faces turned outward."""
    mesh = trimesh.Trimesh(points, faces)
    trimesh.repair.fix_normals(mesh)
    return mesh


def _along(points: Float[np.ndarray, "n 3"], axis: str) -> Float[np.ndarray, "n 3"]:
    """Rotate points so that z becomes the given axis."""
    return {"z": points, "x": points[:, [2, 0, 1]], "y": points[:, [1, 2, 0]]}[axis]
