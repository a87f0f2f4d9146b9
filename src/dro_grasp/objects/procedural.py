"""Objects that do not exist, drawn from a seed, with exact convex parts: they let training see many shapes."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from dro_grasp.errors import ObjectError
from dro_grasp.geometry.mesh_files import trimesh
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.objects.solids import Pieces, Point, Solid, assemble, box, frustum, hollow, ring, superquadric, turned

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
