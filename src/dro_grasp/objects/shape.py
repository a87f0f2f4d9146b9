"""An object: its mesh or cloud, mass, convex parts and signed-distance grid, made once and cached by content."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.errors import ObjectError
from dro_grasp.geometry.point_clouds import partial_view
from dro_grasp.geometry.signed_distance import SignedDistanceGrid
from dro_grasp.objects.cache import cached_arrays

DENSITY = 500.0
"""Density of every object in trials [kg/m^3]. Source: the official release."""
CLOUD_POINTS = 16384
"""Points of an object's stored cloud."""
GRID_SPACING = 0.003
"""Spacing of the signed-distance grid [m]."""
GRID_PADDING = 0.04
"""How far the grid reaches beyond the object [m]."""
DISC_NEIGHBOURS = 7
"""Points of a bare cloud, itself counted, that the disc around each of them reaches to."""
LARGEST_GRID = 8_000_000
"""Grid points beyond which the spacing grows."""

Part = tuple[np.ndarray, np.ndarray]
"""Vertices (n 3) [m] and faces (m 3) of a convex part."""


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """An object in its mesh's frame."""

    name: str
    cloud: np.ndarray
    """(k 3) float32 surface points [m]."""
    cloud_normals: np.ndarray
    """(k 3) float32 outward unit normals."""
    centre_of_mass: np.ndarray
    """(3) [m]; for a bare cloud the mean of its points."""
    sha256: str
    """Hash of the geometry."""
    vertices: np.ndarray | None = None
    """(n 3) [m], or None for a bare cloud."""
    faces: np.ndarray | None = None
    """(m 3), or None for a bare cloud."""
    volume: float = 0.0
    """[m^3]"""
    inertia: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    """Second moments about the centre of mass at unit density [m^5]."""
    notes: tuple[str, ...] = ()
    """What loading found and repaired."""
    split: str | None = None
    """`train`, `validate`, `test`, or None for an object of the user's."""
    exact_parts: tuple[Part, ...] | None = None
    """Convex parts known by construction or from a file; None has them computed."""

    @property
    def is_cloud(self) -> bool:
        """Whether there is no mesh."""
        return self.vertices is None

    @property
    def mass(self) -> float:
        """Mass at DENSITY [kg]."""
        return DENSITY * self.volume

    @property
    def extents(self) -> np.ndarray:
        """Size along the axes (3) [m]."""
        return np.ptp(self.cloud if self.vertices is None else self.vertices, axis=0)

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """Convex parts that fill the object.

        Raises:
            ObjectError: The object is a bare cloud.
        """
        if self.exact_parts is not None:
            return self.exact_parts
        vertices, faces = self._mesh("convex parts")
        from dro_grasp.objects.convex_parts import decompose

        return decompose(vertices, faces, self.sha256)

    @cached_property
    def grid(self) -> SignedDistanceGrid:
        """Signed distances around the object, cached on disk for a mesh."""
        if self.vertices is None or self.faces is None:
            cloud, normals = self.cloud.astype(np.float64), self.cloud_normals.astype(np.float64)
            made = bake_grid(cloud, partial(cloud_distances, cloud, normals))
        else:
            vertices, faces = self.vertices, self.faces
            key = f"grid-{self.sha256[:24]}-{GRID_SPACING * 1e6:.0f}"
            made = cached_arrays(key, lambda: bake_grid(vertices, partial(signed_distances, vertices, faces)))
        values, origin = (torch.from_numpy(made[name].astype(np.float32)) for name in ("values", "origin"))
        return SignedDistanceGrid.from_values(values, origin, float(made["spacing"]))

    def sample_points(self, count: int, generator: torch.Generator) -> Float[Tensor, "count 3"]:
        """Random points of the stored cloud [m]; with repetition where the cloud has too few."""
        if count > len(self.cloud):
            index = torch.randint(len(self.cloud), (count,), generator=generator)
        else:
            index = torch.randperm(len(self.cloud), generator=generator)[:count]
        return torch.from_numpy(self.cloud)[index]

    def sample_partial(self, count: int, generator: torch.Generator) -> Float[Tensor, "count 3"]:
        """A partial cloud as in the paper's appendix: the half facing a random direction."""
        cloud = torch.from_numpy(self.cloud)
        if len(cloud) < 2 * count:
            cloud = self.sample_points(2 * count, generator)
        return cloud[partial_view(cloud, count, generator)]

    def _mesh(self, what: str) -> Part:
        if self.vertices is None or self.faces is None:
            raise ObjectError(f"object '{self.name}' is a bare point cloud and has no {what}; give a mesh instead")
        return self.vertices, self.faces


def bake_grid(surface: np.ndarray, distance: Callable[[np.ndarray], np.ndarray]) -> dict[str, np.ndarray]:
    """Signed distances on a grid around a surface (n 3): `values` (nx ny nz), `origin` (3) and `spacing` [m].

    Args:
        surface: Points that the grid reaches beyond.
        distance: Signed distances of points (n 3).
    """
    low, high = surface.min(0) - GRID_PADDING, surface.max(0) + GRID_PADDING
    spacing = max(GRID_SPACING, float((np.prod(high - low) / LARGEST_GRID) ** (1 / 3)))
    counts = np.ceil((high - low) / spacing).astype(int) + 1
    axes = [low[i] + spacing * np.arange(counts[i]) for i in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return {"values": distance(points).reshape(counts).astype(np.float32), "origin": low, "spacing": np.array(spacing)}


def cloud_distances(cloud: np.ndarray, normals: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distance of each point (n 3) to the disc around the nearest point of a cloud (m 3) [m], negative behind it.

    Discs lie across the normals and reach to the neighbours, so that a surface is closed and a rim is a rim.
    """
    from scipy.spatial import KDTree

    tree = KDTree(cloud)
    some = cloud[:: max(1, len(cloud) // 256)]
    reach = float(np.median(tree.query(some, k=min(DISC_NEIGHBOURS, len(cloud)))[0][:, -1]))
    index = tree.query(points)[1]
    apart = points - cloud[index]
    height = (apart * normals[index]).sum(1)
    beyond = np.maximum(0, np.linalg.norm(apart - height[:, None] * normals[index], axis=1) - reach)
    return np.where(height < 0, -1.0, 1.0) * np.hypot(height, beyond)


def signed_distances(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distance of each point (n 3) to a mesh [m], negative inside.

    Magnitude and sign are computed apart: the winding number copes with holes, flipped faces and overlapping shells.
    """
    import igl

    corners, triangles = np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64)
    squared = igl.point_mesh_squared_distance(points, corners, triangles)[0]
    winding = igl.fast_winding_number(corners, triangles, points)
    return np.where(np.abs(winding) > 0.5, -1.0, 1.0) * np.sqrt(squared)
