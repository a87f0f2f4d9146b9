"""Objects made in code from building blocks, with exact convex parts: the built-in ones, and procedural ones from a seed.

Built-in objects are in a fixed split; objects that do not exist let training see many shapes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import trimesh
from jaxtyping import Float
from numpy.random import Generator

from dro_grasp.errors import ObjectError
from dro_grasp.objects.convex_parts import as_part
from dro_grasp.objects.loading import mesh_object
from dro_grasp.objects.shape import ObjectModel

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
    return [(first + j, first + (j + 1) % corners, centre) for j in range(corners)]


def _outward(points: Float[np.ndarray, "n 3"], faces: list[tuple[int, int, int]]) -> trimesh.Trimesh:
    mesh = trimesh.Trimesh(points, faces)
    trimesh.repair.fix_normals(mesh)
    return mesh


def _along(points: Float[np.ndarray, "n 3"], axis: str) -> Float[np.ndarray, "n 3"]:
    """Rotate points so that z becomes the given axis."""
    return {"z": points, "x": points[:, [2, 0, 1]], "y": points[:, [1, 2, 0]]}[axis]


Pieces = Sequence[trimesh.Trimesh | Solid]  # Convex meshes and solids whose union is the object


@dataclass(frozen=True)
class BuiltinObject:
    """How a built-in object is made."""

    make: Callable[[], Pieces]
    split: str  # `train` or `test`


def _teapot() -> Pieces:
    profile = [(0.03, -0.045), (0.05, -0.02), (0.05, 0.015), (0.03, 0.04), (0.012, 0.045), (0.012, 0.058)]
    spout = hull(np.concatenate([
        frustum((0.012, 0.012), (-0.008, 0.008), (0.045, 0, -0.01)).vertices,
        frustum((0.007, 0.007), (-0.003, 0.003), (0.085, 0, 0.03)).vertices,
    ]))
    return [*turned(profile), spout, ring(0.026, 0.006, 9, arc=np.pi, axis="y", at=(-0.044, 0, 0), start=np.pi)]


def _hammer() -> Pieces:
    head = (0, 0, 0.075)
    return [frustum((0.013, 0.011), (-0.09, 0.07)), frustum((0.016, 0.016), (-0.035, 0.04), head, axis="x"),
            frustum((0.016, 0.006), (-0.06, -0.035), head, axis="x")]


def _wrench() -> Pieces:
    jaw = [box((0.012, 0.028, 0.014), (x, 0, 0.078)) for x in (0.014, -0.014)]
    return [box((0.02, 0.014, 0.15), (0, 0, -0.005)), box((0.04, 0.028, 0.018), (0, 0, 0.066)), *jaw]


def _spray_bottle() -> Pieces:
    body = turned([(0.036, -0.08), (0.036, 0.02), (0.016, 0.05), (0.016, 0.065)])
    return [*body, box((0.075, 0.026, 0.028), (0.012, 0, 0.078)), box((0.01, 0.016, 0.04), (0.04, 0, 0.048))]


def _camera() -> Pieces:
    lens = frustum((0.027, 0.025), (0.018, 0.055), axis="y")
    return [box((0.11, 0.04, 0.07)), lens, box((0.035, 0.03, 0.014), (0, 0, 0.041))]


def _dumbbell() -> Pieces:
    ends = [frustum((0.033, 0.033), heights, axis="x") for heights in ((-0.075, -0.04), (0.04, 0.075))]
    return [frustum((0.014, 0.014), (-0.041, 0.041), axis="x"), *ends]


def _airplane() -> Pieces:
    body = [frustum((0.016, 0.012), (-0.07, 0.06), axis="x"), frustum((0.012, 0.002), (0.06, 0.085), axis="x")]
    tail = [box((0.022, 0.06, 0.008), (-0.06, 0, 0.005)), box((0.022, 0.008, 0.04), (-0.06, 0, 0.025))]
    return [*body, box((0.04, 0.17, 0.012), (0.005, 0, 0)), *tail]


def _duck() -> Pieces:
    beak = hull(np.concatenate([
        frustum((0.011, 0.011), (0.02, 0.022), (0.018, 0, 0.045), axis="x").vertices,
        frustum((0.004, 0.004), (0.036, 0.038), (0.018, 0, 0.042), axis="x").vertices,
    ]))
    body = superquadric((0.046, 0.034, 0.03), (1, 1))
    head = superquadric((0.024, 0.024, 0.024), (1, 1), (0.022, 0, 0.043))
    return [body, head, beak, tilted(box((0.03, 0.03, 0.012), (-0.045, 0, 0.0)), 0.5)]


def _joystick() -> Pieces:
    base, stick = turned([(0.045, -0.05), (0.04, -0.03)]), frustum((0.014, 0.014), (-0.031, 0.03))
    return [*base, stick, superquadric((0.022, 0.022, 0.026), (1, 1), (0, 0, 0.045))]


def _chess_pawn() -> Pieces:
    profile = [(0.032, -0.05), (0.032, -0.04), (0.022, -0.03), (0.012, 0.0), (0.012, 0.02), (0.02, 0.024), (0.02, 0.028)]
    return [*turned(profile), superquadric((0.021, 0.021, 0.021), (1, 1), (0, 0, 0.044))]


def _wine_glass() -> Pieces:
    stem = turned([(0.034, -0.085), (0.034, -0.08), (0.006, -0.074), (0.006, -0.015), (0.02, 0.0), (0.034, 0.02)])
    cup = hollow([(0.034, 0.0), (0.037, 0.03), (0.032, 0.06)], wall=0.005, floor=0.005)
    return [*stem, cup.moved((0, 0, 0.019))]


BUILTIN: dict[str, BuiltinObject] = {name: BuiltinObject(make, split) for name, make, split in (
    ("sphere", lambda: [superquadric((0.035, 0.035, 0.035), (1, 1))], "train"),
    ("ball", lambda: [superquadric((0.045, 0.045, 0.045), (1, 1))], "train"),
    ("egg", lambda: [superquadric((0.026, 0.026, 0.036), (1, 1))], "train"),
    ("ellipsoid", lambda: [superquadric((0.03, 0.04, 0.055), (1, 1))], "train"),
    ("cube", lambda: [box((0.05, 0.05, 0.05))], "train"),
    ("brick", lambda: [box((0.05, 0.07, 0.11))], "train"),
    ("flat_box", lambda: [box((0.09, 0.12, 0.035))], "train"),
    ("tall_box", lambda: [box((0.045, 0.06, 0.15))], "train"),
    ("rounded_box", lambda: [superquadric((0.03, 0.04, 0.05), (0.35, 0.35))], "train"),
    ("pillow", lambda: [superquadric((0.055, 0.045, 0.025), (0.8, 0.5))], "train"),
    ("octahedron", lambda: [superquadric((0.045, 0.045, 0.05), (2, 2))], "train"),
    ("spindle", lambda: [superquadric((0.03, 0.03, 0.07), (1.8, 1))], "train"),
    ("rod", lambda: [frustum((0.018, 0.018), (-0.08, 0.08))], "train"),
    ("can", lambda: [frustum((0.033, 0.033), (-0.06, 0.06))], "train"),
    ("tin", lambda: [frustum((0.045, 0.045), (-0.025, 0.025))], "train"),
    ("cone", lambda: [frustum((0.045, 0.004), (-0.05, 0.06))], "train"),
    ("prism", lambda: [frustum((0.04, 0.04), (-0.05, 0.05), corners=3)], "train"),
    ("hexagon", lambda: [frustum((0.035, 0.035), (-0.045, 0.045), corners=6)], "train"),
    ("pyramid", lambda: [frustum((0.055, 0.003), (-0.035, 0.05), corners=4)], "train"),
    ("bottle", lambda: turned([(0.034, -0.09), (0.036, -0.08), (0.036, 0.02), (0.014, 0.06), (0.014, 0.09)]), "train"),
    ("jar", lambda: turned(
        [(0.036, -0.05), (0.04, -0.04), (0.04, 0.03), (0.034, 0.038), (0.036, 0.04), (0.036, 0.055)]), "train"),
    ("vase", lambda: turned([(0.025, -0.075), (0.04, -0.03), (0.036, 0.01), (0.018, 0.05), (0.026, 0.075)]), "train"),
    ("cup", lambda: [hollow([(0.03, -0.045), (0.034, 0.0), (0.038, 0.045)], wall=0.006, floor=0.006)], "train"),
    ("bowl", lambda: [hollow([(0.03, -0.025), (0.05, -0.005), (0.062, 0.025)], wall=0.008, floor=0.008)], "train"),
    ("torus", lambda: [ring(0.045, 0.015)], "train"),
    ("l_block", lambda: [box((0.04, 0.04, 0.11)), box((0.05, 0.04, 0.04), (0.045, 0, -0.035))], "train"),
    ("t_block", lambda: [box((0.036, 0.036, 0.1)), box((0.11, 0.036, 0.036), (0, 0, 0.068))], "train"),
    ("cross", lambda: [box((0.12, 0.034, 0.034)), box((0.034, 0.12, 0.034))], "train"),
    ("hammer", _hammer, "train"),
    ("dumbbell", _dumbbell, "train"),
    ("light_bulb", lambda: [superquadric((0.032, 0.032, 0.032), (1, 1), (0, 0, 0.02)),
                            *turned([(0.014, -0.045), (0.014, -0.02), (0.026, 0.005)])], "train"),
    ("toy_airplane", _airplane, "train"),
    ("joystick", _joystick, "train"),
    ("wrench", _wrench, "train"),
    ("mug", lambda: [hollow([(0.036, -0.045), (0.038, 0.0), (0.04, 0.045)], wall=0.006, floor=0.006),
                     ring(0.026, 0.006, 9, arc=np.pi, axis="y", at=(0.036, 0, 0))], "test"),
    ("teapot", _teapot, "test"),
    ("screwdriver", lambda: [*turned([(0.012, -0.09), (0.017, -0.075), (0.017, -0.02), (0.010, -0.005)]),
                             frustum((0.0045, 0.0045), (-0.005, 0.09))], "test"),
    ("spray_bottle", _spray_bottle, "test"),
    ("camera", _camera, "test"),
    ("rubber_duck", _duck, "test"),
    ("chess_pawn", _chess_pawn, "test"),
    ("wine_glass", _wine_glass, "test"),
    ("lemon", lambda: [superquadric((0.028, 0.028, 0.04), (1.2, 1))], "test"),
    ("soap", lambda: [superquadric((0.045, 0.03, 0.02), (0.6, 0.6))], "test"),
)}
"""Every built-in object. Test objects never enter a training bundle."""


def make_builtin(name: str, *, scale: float = 1.0) -> ObjectModel:
    """Build one of the built-in objects."""
    kind = BUILTIN[name]
    return assemble(name, kind.make(), scale=scale, split=kind.split)


def assemble(name: str, pieces: Pieces, *, scale: float, split: str) -> ObjectModel:
    """An object that is the union of its pieces, with their exact convex parts."""
    solids = [piece if isinstance(piece, Solid) else Solid(piece, [piece]) for piece in pieces]
    meshes = [solid.mesh for solid in solids]
    mesh = meshes[0] if len(meshes) == 1 else trimesh.boolean.union(meshes, engine="manifold")
    parts = tuple(as_part(part) for solid in solids for part in solid.parts)
    return mesh_object(name, mesh, origin=name, scale=scale, split=split, parts=parts)


PROCEDURAL = re.compile(r"procedural_(\d{1,9})")  # Name of such an object; the number is its seed
SIZE = (0.05, 0.2)  # Range of the largest extent [m] (ours)
STRETCH = (0.75, 1.33)  # Range of the factor along each axis, before the size is set (ours)
THINNEST = 0.012  # Smallest extent of an object [m] (ours): thinner ones cannot be held from a free pose by most hands
ATTEMPTS = 20  # Shapes that are drawn before a seed is given up: some are too thin, and stretching some leaves slivers


def procedural_object(seed: int, *, scale: float = 1.0) -> ObjectModel:
    """The object of a seed (0 or more), the same one every time; `scale` multiplies all coordinates."""
    generator = np.random.default_rng([seed, 15])
    for _ in range(ATTEMPTS):
        pieces = FAMILIES[generator.integers(len(FAMILIES))](generator)
        solids = [piece if isinstance(piece, Solid) else Solid(piece, [piece]) for piece in pieces]
        sized = _sized(solids, generator)
        if sized is not None and all(solid.mesh.is_volume for solid in sized):
            return assemble(f"procedural_{seed}", sized, scale=scale, split="train")
    raise ObjectError(f"seed {seed} makes no object in {ATTEMPTS} attempts; give another one")


def _sized(solids: list[Solid], generator: Generator) -> list[Solid] | None:
    """A shape stretched along the axes and given a size; None if it is too thin."""
    corners = np.concatenate([np.asarray(solid.mesh.vertices) for solid in solids])
    extent = np.ptp(corners, axis=0) * (stretch := generator.uniform(*STRETCH, 3))
    size = np.exp(generator.uniform(*np.log(SIZE)))
    if extent.min() * size / extent.max() < THINNEST:
        return None
    factors = stretch * size / extent.max()

    def stretched(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        return trimesh.Trimesh(np.asarray(mesh.vertices) * factors, np.asarray(mesh.faces), process=False)

    return [Solid(stretched(solid.mesh), [stretched(part) for part in solid.parts]) for solid in solids]


def _blob(g: Generator, size: float = 1.0, at: Point = (0, 0, 0)) -> trimesh.Trimesh:
    """A superquadric, from box to octahedron; the half axes are at most `size`."""
    x, y, z = size * g.uniform(0.4, 1, 3)
    return superquadric((x, y, z), (g.uniform(0.2, 1.8), g.uniform(0.2, 1.8)), at)


def _lump(g: Generator, size: float, at: Point) -> trimesh.Trimesh:
    """A convex piece about a place: a superquadric, a box or a frustum."""
    kind = g.integers(3)
    if kind == 0:
        return _blob(g, size, at)
    if kind == 1:
        x, y, z = 2 * size * g.uniform(0.4, 1, 3)
        return box((x, y, z), at)
    height = size * g.uniform(0.4, 1)
    wide, narrow = size * g.uniform(0.5, 1), size * g.uniform(0.2, 1)
    return frustum((wide, narrow), (-height, height), at, axis="xyz"[g.integers(3)], corners=_corners(g))


def _corners(g: Generator) -> int:
    return int(g.choice([4, 6, 24, 24]))


def _prism(g: Generator) -> Pieces:
    return [frustum((1, g.uniform(0.05, 1)), (-g.uniform(0.3, 2), 1), corners=int(g.choice([3, 4, 5, 6, 8, 24])))]


def _vase(g: Generator) -> Pieces:
    """Radii at rising heights, turned; neighbours differ by a step or a slope."""
    steps = int(g.integers(3, 7))
    heights = np.cumsum(g.uniform(0.15, 1, steps))
    radii = np.clip(np.cumsum(g.normal(0, 0.35, steps)) + 1, 0.3, 1.8)
    return turned(list(zip(radii.tolist(), heights.tolist(), strict=True)))


def _vessel(g: Generator) -> Pieces:
    low, rise, wall = g.uniform(0.5, 1), g.uniform(0, 0.12), 0.16
    height, widening = g.uniform(0.5, 2.5), g.uniform(0, 0.5)
    body = hollow([(low, 0.0), (low + rise, height / 2), (low + rise + widening, height)], wall=wall, floor=wall)
    if g.random() < 0.5:
        return [body]
    radius = height * g.uniform(0.2, 0.33)
    return [body, ring(radius, 0.12, 9, arc=np.pi, axis="y", at=(low - 0.02, 0, height / 2), start=0.0)]


def _blocks(g: Generator) -> Pieces:
    """Two to four boxes that share a region."""
    pieces = [box((1, 1, 1))]
    for _ in range(g.integers(1, 4)):
        size, side = g.uniform(0.5, 2.2, 3), g.uniform(-0.5, 0.5, 3)
        pieces.append(box(tuple(size), tuple(side)))
    return pieces


def _tool(g: Generator) -> Pieces:
    """A long handle, with a head at one end or both."""
    length, thick = g.uniform(1.5, 3), g.uniform(0.15, 0.35)
    corners = _corners(g)
    handle = [frustum((thick, thick * g.uniform(0.7, 1.2)), (-length, length), corners=corners)]
    heads = [_lump(g, g.uniform(0.3, 1.1), (float(g.uniform(-0.3, 0.3)), 0.0, length))]
    if g.random() < 0.3:
        heads.append(_lump(g, g.uniform(0.3, 0.8), (0.0, 0.0, -length)))
    return [*handle, *heads]


def _creature(g: Generator) -> Pieces:
    """A body with one to four lumps at its surface."""
    pieces = [_lump(g, 1.0, (0, 0, 0))]
    for _ in range(g.integers(1, 5)):
        direction = g.normal(size=3)
        x, y, z = 0.6 * direction / np.linalg.norm(direction)
        pieces.append(_lump(g, g.uniform(0.2, 0.7), (float(x), float(y), float(z))))
    return pieces


FAMILIES: tuple[Callable[[Generator], Pieces], ...] = (
    lambda g: [_blob(g)], _prism, _vase, _vessel, lambda g: [ring(1.0, g.uniform(0.15, 0.6))], _blocks, _tool, _tool,
    _creature, _creature)
"""How shapes are made; those that stand twice come twice as often."""
