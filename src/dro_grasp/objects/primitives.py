"""Convex building blocks of the built-in objects, as convex hulls of points."""

from __future__ import annotations

import numpy as np
import trimesh

SEGMENTS = 24
"""Corners of round cross-sections."""


def hull(points: np.ndarray) -> trimesh.Trimesh:
    """Convex hull of points (n 3) [m]."""
    return trimesh.convex.convex_hull(points)


def box(size: tuple[float, float, float], at: tuple[float, float, float] = (0, 0, 0), turn: float = 0.0) -> trimesh.Trimesh:
    """A box of full size [m] at a place, turned about z [rad]."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size
    return hull(_turn(corners, turn) + at)


def frustum(
    radii: tuple[float, float], heights: tuple[float, float], at: tuple[float, float, float] = (0, 0, 0),
    axis: str = "z", corners: int = SEGMENTS,
) -> trimesh.Trimesh:
    """A cone frustum between two heights along an axis [m]; equal radii make a cylinder."""
    angle = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], 1)
    points = np.concatenate([
        np.column_stack([max(r, 1e-4) * ring, np.full(corners, h)]) for r, h in zip(radii, heights, strict=True)
    ])
    return hull(_along(points, axis) + at)


def superquadric(
    size: tuple[float, float, float], exponents: tuple[float, float], at: tuple[float, float, float] = (0, 0, 0)
) -> trimesh.Trimesh:
    """A convex superquadric: half axes [m] and exponents in (0, 2]; 1 is an ellipsoid, near 0 a box, 2 an octahedron."""
    def power(values: np.ndarray, exponent: float) -> np.ndarray:
        return np.sign(values) * np.abs(values) ** exponent

    latitude, longitude = np.meshgrid(np.linspace(-np.pi / 2, np.pi / 2, 17), np.linspace(-np.pi, np.pi, 33)[:-1])
    e1, e2 = exponents
    points = np.stack([
        power(np.cos(latitude), e1) * power(np.cos(longitude), e2),
        power(np.cos(latitude), e1) * power(np.sin(longitude), e2),
        power(np.sin(latitude), e1),
    ], -1).reshape(-1, 3)
    return hull(points * size + at)


def turned(profile: list[tuple[float, float]], at: tuple[float, float, float] = (0, 0, 0)) -> list[trimesh.Trimesh]:
    """A solid of revolution about z from (radius, height) pairs, bottom to top: one frustum a step [m]."""
    return [frustum((a[0], b[0]), (a[1], b[1]), at) for a, b in zip(profile[:-1], profile[1:], strict=True)]


def hollow(
    profile: list[tuple[float, float]], wall: float, floor: float, corners: int = 16
) -> list[trimesh.Trimesh]:
    """A vessel of revolution, open at the top: wall segments and a floor [m]."""
    parts = [frustum((profile[0][0], profile[0][0]), (profile[0][1], profile[0][1] + floor), corners=corners)]
    edges = np.linspace(0, 2 * np.pi, corners + 1)
    for (r0, h0), (r1, h1) in zip(profile[:-1], profile[1:], strict=True):
        for a, b in zip(edges[:-1], edges[1:], strict=True):
            points = [
                (r * np.cos(t), r * np.sin(t), h)
                for r, h in ((r0, h0), (r0 - wall, h0), (r1, h1), (r1 - wall, h1)) for t in (a, b)
            ]
            parts.append(hull(np.array(points)))
    return parts


def ring(radius: float, thickness: float, corners: int = 16, arc: float = 2 * np.pi, axis: str = "z",
         at: tuple[float, float, float] = (0, 0, 0), start: float = 0.0) -> list[trimesh.Trimesh]:
    """A torus, or an arc of one, from convex segments: radius of the middle line and of the tube [m]."""
    parts = []
    edges = np.linspace(start, start + arc, corners + 1)
    tube = np.linspace(0, 2 * np.pi, 10, endpoint=False)
    for a, b in zip(edges[:-1], edges[1:], strict=True):
        points = [
            ((radius + thickness * np.cos(t)) * np.cos(s), (radius + thickness * np.cos(t)) * np.sin(s), thickness * np.sin(t))
            for s in (a, b) for t in tube
        ]
        parts.append(hull(_along(np.array(points), axis) + at))
    return parts


def tilted(parts: list[trimesh.Trimesh], angle: float, axis: str = "y") -> list[trimesh.Trimesh]:
    """Parts turned about an axis through the origin [rad]."""
    direction = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1]}[axis]
    T = trimesh.transformations.rotation_matrix(angle, direction)
    return [hull(trimesh.transform_points(p.vertices, T)) for p in parts]


def _turn(points: np.ndarray, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def _along(points: np.ndarray, axis: str) -> np.ndarray:
    """Points whose z becomes the given axis."""
    return {"z": points, "x": points[:, [2, 0, 1]], "y": points[:, [1, 2, 0]]}[axis]
