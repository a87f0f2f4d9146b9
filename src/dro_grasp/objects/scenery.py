"""What stands around an object, as a mesh or a cloud: read as it is, without the checks and repairs of objects."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from dro_grasp.errors import ObjectError
from dro_grasp.files import given_path
from dro_grasp.geometry.distance_field import DistanceField
from dro_grasp.geometry.mesh_files import trimesh
from dro_grasp.geometry.point_clouds import one_per_cell
from dro_grasp.kinds import checked
from dro_grasp.objects.loading import FARTHEST, check_scale
from dro_grasp.objects.reading import ObjectSource, coordinates, geometry_in_memory, read_geometry, returned
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.objects.surface_distances import banded_values, search_tree, signed_distances

SPACING = 0.005  # Spacing of the grid of distances to a scene [m] (ours)
LARGEST_GRID = 4_000_000  # Most points of such a grid; a larger one gets a wider spacing (ours)
MARGIN = 0.03  # Distance around a scene that its grid covers [m] (ours); beyond, distances grow as they do at its border
TOUCH = 0.003  # Distance to a scene at which a point of an object's surface lies on it [m] (ours)


@dataclass(frozen=True, eq=False)
class Scene:
    """A mesh, or a cloud of points, in the frame of an object."""

    name: str
    """Name, for messages."""
    points: Float[np.ndarray, "n 3"]
    """Vertices, or points of the cloud [m]."""
    faces: Int[np.ndarray, "m 3"] | None = None
    """Vertex indices of the mesh's triangles; None for a cloud."""

    def __repr__(self) -> str:
        made = f"cloud of {len(self.points)} points" if self.faces is None else f"mesh of {len(self.faces)} faces"
        return f"Scene('{self.name}', {made})"

    def moved(self, T: Float[np.ndarray, "4 4"]) -> Scene:
        """The same in another frame; T takes its coordinates there [m]."""
        return Scene(self.name, trimesh.transform_points(self.points, T), self.faces)

    def near(self, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> DistanceField | None:
        """Signed distances within a box [m]; None where nothing of the scene is near the box.

        Each point of a cloud is a ball as wide as the points are apart, so that nothing slips between them. A mesh is solid.
        """
        low = np.maximum(low, self.points.min(0) - MARGIN)
        high = np.minimum(high, self.points.max(0) + MARGIN)
        if not (low < high).all():
            return None
        if self.faces is not None:
            distance = partial(signed_distances, self.points, self.faces)
        else:
            own = self.points[((self.points > low - MARGIN) & (self.points < high + MARGIN)).all(1)]
            if not len(own):
                return None
            distance = _ball_distances(own)
        spacing = max(SPACING, float((np.prod(high - low) / LARGEST_GRID) ** (1 / 3)))
        counts = np.ceil((high - low) / spacing).astype(int) + 2
        values = banded_values(distance, low, counts, spacing)
        return DistanceField.from_values(torch.from_numpy(values).float(), torch.from_numpy(low).float(), spacing)

    def require_apart(self, obj: ObjectModel) -> None:
        """Refuse a scene that contains the object itself, by an ObjectError: no hand could touch it."""
        if self.faces is None:
            distance, most = KDTree(self.points).query(obj.cloud)[0], 0.2
        else:
            distance, most = signed_distances(self.points, self.faces, obj.cloud.astype(np.float64)), 0.5
        on = distance < TOUCH
        if on.mean() <= most:  # (ours) objects touch what they stand on
            return
        flat = float(np.linalg.norm(obj.cloud_normals[on].mean(0)))
        if flat < 0.85 or on.mean() > 0.5:  # (ours) otherwise it is the flat side on which the object stands
            raise ObjectError(f"the scene '{self.name}' contains object '{obj.name}': {100 * on.mean():.0f} % of "
                              "the object's surface lies on it or inside. Cut the object out of the scene, or check that "
                              "both are in one frame and in metres")


@checked
def load_scene(source: ObjectSource, name: str | None = None, scale: float = 1.0) -> Scene:
    """What a hand is to avoid, from the path of a mesh or cloud, a trimesh mesh or cloud, (vertices, faces), or points (n 3).

    Args:
        source: The mesh or cloud, in the frame of the object that is to be grasped. Points with NaN and (0, 0, 0) are left out.
        name: What to call it; the file's stem by default.
        scale: Multiplies all coordinates; 0.001 for millimetres.

    Raises:
        ObjectError: It cannot be read, is empty, or is not in metres, or `scale` is not positive.
    """
    check_scale(scale)
    geometry: Any
    if isinstance(source, str | Path):
        path = given_path(source)
        if not path.is_file():
            raise ObjectError(f"no file at {path}; give the mesh or cloud of the obstacles (STL, OBJ, PLY, NPY, PCD)")
        (geometry, unit), label, origin = read_geometry(path), name or path.stem, str(path)
    else:
        (geometry, unit), label, origin = geometry_in_memory(source), name or "scene", "the given scene"
    if isinstance(geometry, trimesh.Trimesh):
        points, faces = np.asarray(geometry.vertices, np.float64), np.asarray(geometry.faces, np.int64)
        if not len(faces) or faces.min() < 0 or faces.max() >= len(points) or not np.isfinite(points).all():
            raise ObjectError(f"{origin} has {len(faces)} faces, or vertices that are absent or not finite; repair the mesh, "
                              "or give a cloud")
    else:
        points, faces = coordinates(geometry, origin), None
        points = points[returned(points)]
    points = points * (scale * unit)
    if not len(points):
        raise ObjectError(f"{origin} holds no point; leave the scene out if nothing is to be avoided")
    if np.abs(points).max() > FARTHEST:
        raise ObjectError(f"{origin} has coordinates of up to {np.abs(points).max():.3g} m; divide millimetres by 1000 "
                          f"(scale), and leave out what is farther away than {FARTHEST:g} m")
    if faces is None:
        points = points[one_per_cell(points, 0.004)]  # [m] (ours): cameras see far more
    return Scene(label, points, faces)


def _ball_distances(points: Float[np.ndarray, "n 3"]) -> Any:
    """Distances to balls around points; they overlap those of their neighbours."""
    tree = search_tree(points)
    apart = tree.query(points, k=min(4, len(points)))[0][:, -1] if len(points) > 1 else np.zeros(1)
    radius = min(float(np.median(apart)) / 2, MARGIN / 3)
    return lambda places: tree.query(places)[0] - radius
