"""Building blocks of objects that are made in code, and their union: a mesh with exact convex parts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from dro_grasp.geometry.mesh_files import trimesh
from dro_grasp.objects.convex_parts import as_part
from dro_grasp.objects.loading import mesh_object
from dro_grasp.objects.shape import DENSITY, ObjectModel

Point = tuple[float, float, float]  # Coordinates [m]
Loop = Float[np.ndarray, "m 2"]  # Corners of a plane outline, counter-clockwise [m]
Profile = list[tuple[float, float]]  # Offsets or radii, and heights [m]
SQUARE = ((1, 1), (-1, 1), (-1, -1), (1, -1))
"""Signs of the corners of a rectangle, counter-clockwise."""


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


Piece = trimesh.Trimesh | Solid  # A convex mesh, or a solid
Pieces = Sequence[Piece]  # Pieces whose union is the object


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

    The profile has (radius, height) pairs of the outside, bottom to top; the floor lies below the second, `wall` is level.
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
    return swept(loops, closed)


def tilted(part: trimesh.Trimesh, angle: float) -> trimesh.Trimesh:
    """A part turned about the y axis [rad]."""
    T = trimesh.transformations.rotation_matrix(angle, [0, 1, 0])
    return hull(trimesh.transform_points(part.vertices, T))


def spar(stations: list[tuple[float, float, float, float]]) -> list[trimesh.Trimesh]:
    """A bar along x of rectangular sections that change: (x, width along y, height along z, z of the middle) [m]."""
    sections = [np.array([(x, side * width / 2, z + above * height / 2) for side, above in SQUARE])
                for x, width, height, z in stations]
    return [hull(np.concatenate(pair)) for pair in pairwise(sections)]


def slab(outline: Loop, low: float, high: float) -> trimesh.Trimesh:
    """A convex outline in the plane between two heights [m]."""
    return hull(np.concatenate([at_height(outline, low), at_height(outline, high)]))


def bar(path: Float[np.ndarray, "n 3"], section: Loop, closed: bool = False, up: Point = (0, 0, 1)) -> Solid:
    """A bar of one convex section along a line of straight pieces with mitred corners [m].

    The second coordinate of the section is along `up`, as far as the first piece of the line allows, the first is to its left.
    """
    ahead = np.diff(np.concatenate([path, path[:1]]) if closed else path, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    left = np.cross(up, ahead[0])
    left /= np.linalg.norm(left)
    loop = path[0] + section @ np.stack([left, np.cross(ahead[0], left)])
    loops = [_until(loop, ahead[0], path[0], ahead[-1] + ahead[0]) if closed else loop]
    for k in range(1, len(path)):
        following = ahead[k] if k < len(ahead) else ahead[-1]
        loops.append(_until(loops[-1], ahead[k - 1], path[k], ahead[k - 1] + following))
    return swept(loops, closed)


def _until(loop: Float[np.ndarray, "m 3"], along: Float[np.ndarray, "3"], at: Float[np.ndarray, "3"],
           normal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "m 3"]:
    """Points moved along a direction until they lie in the plane through a place."""
    return loop + np.outer((at - loop) @ normal / (along @ normal), along)


def swept(loops: list[Float[np.ndarray, "m 3"]], closed: bool = False) -> Solid:
    """The solid through convex loops of equally many points, one convex part between each loop and the next.

    It is exact where the sides between the loops are flat.
    """
    pairs = pairwise([*loops, loops[0]] if closed else loops)
    return Solid(_swept(loops, closed), [hull(np.concatenate(pair)) for pair in pairs])


def washer(outer: Loop, inner: Loop, low: float, high: float) -> Solid:
    """A flat piece with a hole, between two heights [m]: a convex outline around another, of equally many points."""
    return swept([np.array([(*o, low), (*o, high), (*i, high), (*i, low)]) for o, i in zip(outer, inner, strict=True)], True)


def vessel(outline: Callable[[float], Loop], outer: Profile, inner: Profile) -> Solid:
    """A vessel with a level floor, open at the top [m]: from (offset, height) pairs of the outside and of the inside.

    Both go from the floor to the rim with one another; the outline of an offset has parallel sides at every offset.
    """
    def loops(profile: Profile) -> list[Float[np.ndarray, "m 3"]]:
        return [at_height(outline(offset), height) for offset, height in profile]

    outside, inside = loops(outer), loops(inner)
    parts = [hull(np.concatenate([outside[0], inside[0]]))]
    for (o, i), (over_o, over_i) in pairwise(zip(outside, inside, strict=True)):
        for j in range(len(o)):
            corners = [j, (j + 1) % len(o)]
            parts.append(hull(np.concatenate([ring[corners] for ring in (o, i, over_o, over_i)])))
    return Solid(_swept([*outside, *inside[::-1]], closed=False), parts)


def circle(radius: float, corners: int = 24) -> Loop:
    """A circle as a polygon with its corners on it [m]."""
    return arc((radius, radius), (0, 360), corners, closed=True)


def arc(radii: tuple[float, float], span: tuple[float, float], count: int, at: tuple[float, float] = (0, 0),
        closed: bool = False) -> Loop:
    """Points on an ellipse of half axes [m] between two angles [degree]; closed leaves out the last, which is the first."""
    angle = np.radians(np.linspace(*span, count, endpoint=not closed))
    return np.stack([np.cos(angle), np.sin(angle)], 1) * radii + at


def rectangle(half: tuple[float, float], radius: float = 0.0, corner: int = 1) -> Loop:
    """A rectangle of half sides [m] with corners of a radius, each of so many points; its sides grow with the radius."""
    bend = [arc((radius, radius), (90.0 * k, 90.0 * (k + 1)), corner) if corner > 1 else radius * np.array([SQUARE[k]])
            for k in range(4)]
    return np.concatenate([half * np.array(SQUARE[k]) + bend[k] for k in range(4)])


def at_height(outline: Loop, height: float) -> Float[np.ndarray, "m 3"]:
    """A plane outline in space [m]."""
    return np.column_stack([outline, np.full(len(outline), height)])


def upright(outline: Loop, at: Point = (0, 0, 0), along: str = "x") -> Float[np.ndarray, "m 3"]:
    """A plane line in space [m], its second coordinate up, its first along x or y."""
    points = np.zeros((len(outline), 3))
    points[:, [0 if along == "x" else 1, 2]] = outline
    return points + at


def placed(piece: Piece, at: Point = (0, 0, 0), turn: Point = (0, 0, 0), stretch: Point = (1, 1, 1)) -> Piece:
    """A piece stretched along the axes, then turned about x, y and z in this order [degree], then moved [m]."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", turn, degrees=True).as_matrix() * stretch
    T[:3, 3] = at
    if isinstance(piece, Solid):
        return Solid(piece.mesh.copy().apply_transform(T), [part.copy().apply_transform(T) for part in piece.parts])
    return piece.copy().apply_transform(T)


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
    return [(first + j, first + (j + 1) % corners, centre) for j in range(corners)]


def _outward(points: Float[np.ndarray, "n 3"], faces: list[tuple[int, int, int]]) -> trimesh.Trimesh:
    mesh = trimesh.Trimesh(points, faces)
    trimesh.repair.fix_normals(mesh)
    return mesh


def _along(points: Float[np.ndarray, "n 3"], axis: str) -> Float[np.ndarray, "n 3"]:
    """Rotate points so that z becomes the given axis."""
    return {"z": points, "x": points[:, [2, 0, 1]], "y": points[:, [1, 2, 0]]}[axis]


def assemble(
    name: str, pieces: Pieces, *, scale: float, split: str, mass: float | None = None, density: float = DENSITY
) -> ObjectModel:
    """An object that is the union of its pieces, with their exact convex parts.

    A `mass` [kg], that at scale 1, replaces the `density` [kg/m^3].
    """
    solids = [piece if isinstance(piece, Solid) else Solid(piece, [piece]) for piece in pieces]
    meshes = [solid.mesh for solid in solids]
    mesh = meshes[0] if len(meshes) == 1 else trimesh.boolean.union(meshes, engine="manifold")
    parts = tuple(as_part(part) for solid in solids for part in solid.parts)
    obj = mesh_object(name, mesh, origin=name, scale=scale, split=split, parts=parts)
    return replace(obj, density=density if mass is None else mass * scale**3 / obj.volume)
