"""An object: its mesh or cloud, mass, convex parts and signed distances, derived once and cached by content."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from dro_grasp.errors import ObjectError
from dro_grasp.geometry.cache import cached_arrays, content_hash
from dro_grasp.geometry.distance_field import Balls, DistanceField
from dro_grasp.geometry.point_clouds import one_per_cell, random_half
from dro_grasp.objects.convex_parts import Part, Progress, coarse_parts, decompose, pack
from dro_grasp.objects.surface_distances import GRID_SPACING, bake_grid, closed_cloud_distances, signed_distances

DENSITY = 500.0  # Density of every object that states none [kg/m^3]. Source: the official release
LARGEST_MASS = 100.0  # Largest mass that is accepted [kg] (ours): more are grams, or nothing for a hand
CLOUD_POINTS = 16384  # Points of an object's stored cloud (ours)
BALL_RADII = (0.008, 0.006, 0.004, 0.003, 0.002)
"""Radii of balls [m]; each point gets the largest that stays inside, or else the smallest (ours)."""
BALL_SPACING = 0.008
"""Distance between the points that are touched [m] (ours): between the largest balls the surface is 1 mm low."""
MAX_BALLS = 2000  # Balls of a solid at most (ours): larger things get larger balls, farther apart. Hands take in a few hundred
BALL_OUTSIDE = 0.0012  # How far a ball may reach through the surface elsewhere [m] (ours)
SEEN_WITHIN = 0.004  # Distance from the next seen point up to which a point of an estimated object is known [m] (ours)
GUESSED_FROM = 0.016  # The same from which it is a guess altogether (ours)
ROUND = 1e-12  # Added to the inertia at unit density [m^5], so that a flat cloud has one about every axis (ours)


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """An object in its mesh's frame."""

    name: str
    """Name of the object."""
    cloud: Float[np.ndarray, "k 3"]
    """Surface points in single precision [m]."""
    cloud_normals: Float[np.ndarray, "k 3"]
    """Outward unit normals of the points."""
    centre_of_mass: Float[np.ndarray, "3"]
    """Centre of mass [m]; the mean of the points for a bare cloud."""
    sha256: str
    """Hash of the mesh's vertices and faces, or of a bare cloud's points, which grasp files state; see `solid_sha256`."""
    vertices: Float[np.ndarray, "n 3"] | None = None
    """Vertices of the mesh [m], or None for a bare cloud."""
    faces: Int[np.ndarray, "m 3"] | None = None
    """Vertex indices of the mesh's triangles, or None for a bare cloud."""
    volume: float = 0.0
    """Volume [m^3]; 0 for a bare cloud."""
    inertia: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.zeros((3, 3)))
    """Inertia about the centre of mass at unit density [m^5]."""
    table: Float[np.ndarray, "4"] | None = None
    """Plane that a bare cloud was cut from: upward unit normal, and height along it [m]."""
    notes: tuple[str, ...] = ()
    """Findings and repairs of the loader, and of the cutting into convex parts once that is done."""
    split: str | None = None
    """`train`, `validate`, `test`, or None for a user's object."""
    exact_parts: tuple[Part, ...] | None = None
    """Convex parts known by construction or from a file; None computes them."""
    seen: Float[np.ndarray, "m 3"] | None = None
    """What was seen of a bare cloud whose other points are a guess, in single precision [m]; None where nothing is."""
    balls: Balls | None = None
    """What a bare cloud collides as where hands close on it; see `solid_of`."""
    file: str | None = None
    """The file it was loaded from, if it is a user's own."""
    scale: float = 1.0
    """Factor that the file's coordinates were multiplied by."""
    density: float = DENSITY
    """Mass over volume [kg/m^3]."""
    stated_mass: float | None = None
    """The mass, if `with_mass` stated it [kg]."""

    def __repr__(self) -> str:
        size = " x ".join(f"{100 * side:.1f}" for side in self.extents)
        made = f"bare cloud of {len(self.cloud)} points" if self.faces is None else f"mesh of {len(self.faces)} faces"
        return f"ObjectModel('{self.name}', {made}, {size} cm{'' if self.is_cloud else f', {1e3 * self.mass:.0f} g'})"

    @property
    def is_cloud(self) -> bool:
        """Whether this is a bare cloud, without a mesh."""
        return self.vertices is None

    @cached_property
    def guessed(self) -> Float[np.ndarray, " k"]:
        """How much each point of the cloud is a guess, from 0 (known) to 1; 0 where `seen` is None."""
        if self.seen is None:
            return np.zeros(len(self.cloud))
        away = KDTree(self.seen).query(self.cloud)[0]
        return np.clip((away - SEEN_WITHIN) / (GUESSED_FROM - SEEN_WITHIN), 0, 1)

    @property
    def mass(self) -> float:
        """Mass [kg]; it is spread evenly over the volume."""
        return self.density * self.volume

    @property
    def extents(self) -> Float[np.ndarray, "3"]:
        """Size along the axes [m]."""
        return np.ptp(self.cloud if self.vertices is None else self.vertices, axis=0)

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """Convex parts that fill the object, which is no bare cloud; `notes` then say what is odd about them."""
        return self.cut()

    def cut(self, progress: Progress | None = None) -> tuple[Part, ...]:
        """The convex parts; the first call cuts a mesh that states none, and tells `progress` of it."""
        if self.exact_parts is not None:
            return self.exact_parts
        if (known := vars(self).get("parts")) is not None:
            return known
        if self.vertices is None or self.faces is None:
            raise ObjectError(f"object '{self.name}' is a bare point cloud and has no convex parts; give a mesh instead")
        made = decompose(self.vertices, self.faces, self.sha256, progress)
        vars(self)["parts"] = made.parts
        if made.note is not None and made.note not in self.notes:
            vars(self)["notes"] = (*self.notes, made.note)
        return made.parts

    @cached_property
    def coarse(self) -> ObjectModel:
        """The same object with fewer and simpler convex parts, as another tool might cut it."""
        return replace(self, exact_parts=coarse_parts(self.parts))

    @cached_property
    def solid_sha256(self) -> str:
        """Hash of all that a simulation sees of it: shape, mass properties, and its convex parts or balls.

        One mesh may have other parts: a built-in object's are exact, those of the same mesh in a user's file are cut.
        """
        # The usual density is left out: hashes in files of before densities could be stated stay what they are.
        own = [] if self.density == DENSITY else [self.density]
        mass = np.array([self.volume, *self.centre_of_mass, *self.inertia.ravel(), *own])
        if self.balls is not None:
            solid = [self.balls.centres.numpy(), self.balls.radii.numpy()]
        else:
            solid = [] if self.is_cloud else list(pack(self.parts).values())
        shape = np.frombuffer(self.sha256.encode(), np.uint8)
        return content_hash(shape, *([self.cloud, self.cloud_normals] if self.is_cloud else []), mass, *solid)

    @cached_property
    def distance_field(self) -> DistanceField:
        """Signed distances around the object; for a mesh, their grid is cached on disk."""
        if self.vertices is None or self.faces is None:
            cloud, normals = self.cloud.astype(np.float64), self.cloud_normals.astype(np.float64)
            grid = bake_grid(cloud, partial(closed_cloud_distances, cloud, normals), banded=True)
        else:
            vertices, faces = self.vertices, self.faces
            key = f"grid-{self.sha256[:24]}-{GRID_SPACING * 1e6:.0f}"
            grid = cached_arrays(key, lambda: bake_grid(vertices, partial(signed_distances, vertices, faces)))
        values, origin = (torch.from_numpy(grid[name].astype(np.float32)) for name in ("values", "origin"))
        return DistanceField.from_values(values, origin, float(grid["spacing"]))

    def sample_points(self, count: int, generator: torch.Generator) -> Float[Tensor, "count 3"]:
        """Random points of the stored cloud [m]; points repeat if the cloud has too few."""
        if count > len(self.cloud):
            index = torch.randint(len(self.cloud), (count,), generator=generator)
        else:
            index = torch.randperm(len(self.cloud), generator=generator)[:count]
        return torch.from_numpy(self.cloud)[index]

    def sample_partial(self, count: int, generator: torch.Generator) -> Float[Tensor, "count 3"]:
        """A partial cloud as in the paper's appendix: the half along a random direction [m]."""
        cloud = torch.from_numpy(self.cloud)
        if len(cloud) < 2 * count:
            cloud = self.sample_points(2 * count, generator)
        return cloud[random_half(cloud, count, generator)]


def check_mass(mass: float) -> None:
    """Refuse a mass [kg] that is not above 0, or larger than any hand holds: ObjectError."""
    if not 0 < mass <= LARGEST_MASS:
        grams = f"; {mass:g} g are {mass / 1e3:g} kg" if LARGEST_MASS < mass < 1e5 else ""
        raise ObjectError(f"mass is {mass}; give kilograms, above 0 and at most {LARGEST_MASS:g}, for example 0.4{grams}")


def with_mass(obj: ObjectModel, mass: float) -> ObjectModel:
    """The same object with this mass [kg], spread evenly over its volume; of a bare cloud, over what it encloses.

    Raises:
        ObjectError: The mass is not above 0, or larger than any hand holds.
    """
    check_mass(mass)
    heavy = replace(obj, density=mass / (obj.volume or solid_of(obj).volume), stated_mass=mass)
    if (field := vars(obj).get("distance_field")) is not None:  # a bare cloud's takes a second to compute again
        vars(heavy)["distance_field"] = field
    return heavy


def solid_of(obj: ObjectModel) -> ObjectModel:
    """What the closing of a hand is simulated on: a mesh as it is; a bare cloud with balls, and the mass of what it encloses.

    Trials take the cloud itself, and refuse it: what becomes of an estimate is no outcome.
    """
    if not obj.is_cloud or obj.balls is not None:
        return obj
    cell, inside = _enclosed(obj)
    centre = inside.mean(0)
    apart = inside - centre
    products = cell * apart.T @ apart
    return replace(
        obj, balls=_balls(obj), volume=cell * len(inside), centre_of_mass=centre,
        inertia=np.trace(products) * np.eye(3) - products + ROUND * np.eye(3))


def _enclosed(obj: ObjectModel) -> tuple[float, Float[np.ndarray, "n 3"]]:
    """Volume [m^3] and middles [m] of the cells inside a cloud; of those with points if it encloses none."""
    field = obj.distance_field
    nodes = np.indices(field.shape).reshape(3, -1).T[field.slopes[:, 0].numpy() < 0]
    inside = nodes * field.spacing + field.origin.numpy()
    if not len(inside):
        inside = (np.unique(np.floor(obj.cloud / field.spacing), axis=0) + 0.5) * field.spacing
    return field.spacing**3, inside.astype(float)


def _spread(cloud: Float[np.ndarray, "m 3"], spacing: float) -> Int[np.ndarray, " k"]:
    """Rows of points about this far apart [m]: the one nearest to the middle of each cell of a grid."""
    order = np.linalg.norm(cloud / spacing - np.floor(cloud / spacing) - 0.5, axis=1).argsort(kind="stable")
    return order[one_per_cell(cloud[order], spacing)]


def _balls(obj: ObjectModel) -> Balls:
    """Balls that touch a cloud with normals from inside."""
    cloud, radii, spacing = obj.cloud.astype(float), np.array(BALL_RADII), BALL_SPACING
    while len(rows := _spread(cloud, spacing)) > MAX_BALLS:
        spacing *= 1.25  # (ours)
        radii = np.array([BALL_RADII[0] * spacing / BALL_SPACING, *BALL_RADII])
    centres = cloud[rows] - radii[:, None, None] * obj.cloud_normals[rows]
    depth = -obj.distance_field.distances(torch.from_numpy(centres).float())[0].numpy()
    fits = depth > radii[:, None] - BALL_OUTSIDE
    fits[-1] = True
    largest = fits.argmax(0)
    return Balls(torch.from_numpy(centres[largest, np.arange(len(rows))]), torch.from_numpy(radii[largest]))
