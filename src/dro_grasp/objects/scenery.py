"""Scenes: what a camera saw, of which one object is meant and all else is avoided; or a mesh or cloud of what is avoided."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from dro_grasp.errors import ObjectError
from dro_grasp.files import given_path
from dro_grasp.geometry.distance_field import DistanceField
from dro_grasp.geometry.mesh_files import trimesh
from dro_grasp.geometry.point_clouds import one_per_cell
from dro_grasp.kinds import checked
from dro_grasp.objects.loading import FARTHEST, check_scale
from dro_grasp.objects.perception.choosing import Chosen, Pixel, Sight, Spot, choose
from dro_grasp.objects.perception.scene_files import (
    SceneCamera,
    as_camera,
    is_depth,
    read_depth,
    sight_of_cloud,
    sight_of_depth,
)
from dro_grasp.objects.perception.segmentation import Segments, segment
from dro_grasp.objects.perception.taking import taken_object
from dro_grasp.objects.reading import ObjectSource, coordinates, geometry_in_memory, numbers, read_geometry
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.objects.surface_distances import banded_values, search_tree, signed_distances

SPACING = 0.005  # Spacing of the grid of distances to a scene [m] (ours)
LARGEST_GRID = 4_000_000  # Most points of such a grid; a larger one gets a wider spacing (ours)
MARGIN = 0.03  # Distance around a scene that its grid covers [m] (ours); beyond, distances grow as they do at its border
THIN = 0.004  # Edge of the cubes of which each keeps one point of a cloud [m] (ours): cameras see far more
SPECK = 0.0025  # Extent of a scene below which its scale is doubted [m] (ours): a room in millimetres that were metres has 3 mm
TOUCH = 0.003  # Distance to a scene at which a point of an object's surface lies on it [m] (ours)

Distance = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, " n"]]  # Of places [m]


@dataclass(frozen=True, eq=False)
class FoundObject:
    """The one object of a scene that is meant, and all else."""

    obj: ObjectModel
    """In the frame of the scene, with the plane on which it stands as its table, and notes on what is uncertain."""
    obstacles: Scene | None
    """All that was seen but the object and what it stands on; None for nothing."""
    chosen: Chosen
    """Which points were taken."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A mesh, or a cloud of points, in the frame of an object or in the one that its camera file names."""

    name: str
    """Name, for messages."""
    points: Float[np.ndarray, "n 3"]
    """Vertices, or points of the cloud [m]."""
    faces: Int[np.ndarray, "m 3"] | None = None
    """Vertex indices of the mesh's triangles; None for a cloud."""
    sight: Sight | None = None
    """All points as they were seen; None for a mesh."""
    beside: tuple[Scene, ...] = ()
    """Further scenes in the same frame, which are avoided as well."""
    whole: Scene | None = None
    """All that was seen, where this is a part of it; None where it is all."""

    def __repr__(self) -> str:
        made = f"cloud of {len(self.points)} points" if self.faces is None else f"mesh of {len(self.faces)} faces"
        return f"Scene('{self.name}', {made})"

    def moved(self, T: Float[np.ndarray, "4 4"]) -> Scene:
        """The same in another frame; T takes its coordinates there [m]."""
        sight = None if self.sight is None else self.sight.moved(T)
        beside = tuple(scene.moved(T) for scene in self.beside)
        whole = None if self.whole is None else self.whole.moved(T)
        return Scene(self.name, trimesh.transform_points(self.points, T), self.faces, sight, beside, whole)

    def joined(self, other: Scene | None) -> Scene:
        """Both, to be avoided; both are in one frame."""
        return self if other is None else replace(self, beside=(*self.beside, other))

    @property
    def parts(self) -> tuple[Scene, ...]:
        """This scene alone, and those beside it."""
        return (replace(self, beside=()), *(part for scene in self.beside for part in scene.parts))

    def of(self, kept: Bool[np.ndarray, " n"]) -> Scene:
        """The same with some of its points alone, of those that were seen; it knows the whole."""
        assert self.sight is not None
        return replace(_seen(self.name, self.sight.of(kept), self.name), whole=self.whole or self)

    @cached_property
    def segments(self) -> Segments:
        """Planes and things of the cloud, in the camera's frame if there is one.

        Raises:
            ObjectError: The scene is a mesh.
        """
        if self.sight is None:
            raise ObjectError(f"the scene '{self.name}' is a mesh; give what a camera saw, a cloud or a depth image, to take "
                              "one object out of it, or the object's own mesh")
        camera, up = (np.zeros(3), self.sight.T[2, :3]) if self.sight.from_camera else (None, None)
        return segment(self.sight.points, camera, up)

    def points_seen(self) -> Float[np.ndarray, "n 3"]:
        """All points as they were seen, in the scene's frame [m], as `segments` label them."""
        assert self.sight is not None
        return self.sight.world()

    def spot(self, number: int) -> Float[np.ndarray, "3"]:
        """The point of a thing that is nearest to the middle of its points [m]."""
        points = self.points_seen()[self.segments.labels == number]
        return points[np.linalg.norm(points - points.mean(0), axis=1).argmin()]

    def chosen(
        self, at: Spot | None = None, pixel: Pixel | None = None, mask: Any = None, nearest: bool = False, part: bool = False
    ) -> Chosen:
        """Which points are the object's; arguments as for `object_at`."""
        segments = self.segments
        assert self.sight is not None
        return choose(self.name, self.sight, segments, at, pixel, mask, nearest, part)

    @checked
    def object_at(
        self, at: Spot | None = None, *, pixel: Pixel | None = None, mask: Any = None,
        nearest: bool = False, part: bool = False, name: str | None = None,
    ) -> FoundObject:
        """The object that is meant, completed, and all else as obstacles.

        Examples:
            >>> found = load_scene("depth.png", camera="camera.json").object_at(pixel=(310, 220))
            >>> grasps = GraspPredictor().predict(hand, found.obj, obstacles=found.obstacles)

        Args:
            at: A place on it or near it, in the scene's frame: x, y, z [m].
            pixel: A pixel that shows it: column and row, from the upper left.
            mask: Its pixels: an array (h, w), true or not 0 on the object, or the path of a PNG.
            nearest: Take what is nearest to the camera.
            part: Of things that touch, take the one side at the place or the pixel; the other one is avoided.
            name: What to call it; the scene's name by default.

        With none of them, the scene has to show one thing alone.

        Raises:
            ObjectError: There is no thing there, or it is not clear which is meant.
            OptionError: Two of them are given, or the scene lacks what one of them needs.
        """
        chosen = self.chosen(at, pixel, mask, nearest, part)
        assert self.sight is not None
        obj = taken_object(name or self.name, self.sight, self.segments, chosen)
        others = self.sight.world()[chosen.others]
        obstacles = Scene(f"what else '{self.name}' shows", others[one_per_cell(others, THIN)]) if len(others) else None
        return FoundObject(obj, obstacles, chosen)

    def near(self, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> DistanceField | None:
        """Signed distances within a box [m]; None where nothing of the scene is near the box.

        Each point of a cloud is a ball as wide as the points are apart, so that nothing slips between them. A mesh is solid.
        """
        parts = self.parts
        low = np.maximum(low, np.min([part.points.min(0) for part in parts], axis=0) - MARGIN)
        high = np.minimum(high, np.max([part.points.max(0) for part in parts], axis=0) + MARGIN)
        if not (low < high).all():
            return None
        found = [own for part in parts if (own := part._distance(low - MARGIN, high + MARGIN)) is not None]
        if not found:
            return None
        spacing = max(SPACING, float((np.prod(high - low) / LARGEST_GRID) ** (1 / 3)))
        counts = np.ceil((high - low) / spacing).astype(int) + 2
        values = banded_values(lambda places: np.min([own(places) for own in found], axis=0), low, counts, spacing)
        return DistanceField.from_values(torch.from_numpy(values).float(), torch.from_numpy(low).float(), spacing)

    def _distance(self, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> Distance | None:
        """Signed distances of places to this scene alone [m], near a box; None for a cloud that has no point in it."""
        if self.faces is not None:
            return partial(signed_distances, self.points, self.faces)
        own = self.points[((self.points > low) & (self.points < high)).all(1)]
        return _ball_distances(own) if len(own) else None

    def require_apart(self, obj: ObjectModel) -> None:
        """Refuse a scene that contains the object itself, by an ObjectError: no hand could touch it."""
        for scene in self.beside:
            scene.require_apart(obj)
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
def load_scene(
    source: ObjectSource, name: str | None = None, scale: float = 1.0, *, camera: SceneCamera | Path | str | None = None
) -> Scene:
    """A scene, from the path of a mesh, cloud or depth image, a trimesh mesh or cloud, (vertices, faces), points or depths.

    Args:
        source: With a camera: what it saw, a cloud in its frame or a depth image along z, (h, w), as an array, PNG, TIFF or
            NPY. Without: a mesh or cloud in the frame of the object. Points with NaN and (0, 0, 0) are left out.
        name: What to call it; the file's stem by default.
        scale: Multiplies all coordinates; 0.001 for millimetres.
        camera: The camera, or the path of its JSON file.

    Raises:
        ObjectError: It cannot be read, is empty, or is not in metres, or `scale` is not positive.
        OptionError: The camera's file is none, or has no intrinsics for a depth image.
    """
    check_scale(scale)
    seen_by = None if camera is None else as_camera(camera)
    geometry: Any
    if isinstance(source, str | Path):
        path = given_path(source)
        if not path.is_file():
            raise ObjectError(f"no file at {path}; give what a camera saw of the scene (NPY, PLY, PCD, PNG, TIFF), or the mesh "
                              "or cloud of what is to be avoided (also STL, OBJ)")
        label, origin = name or path.stem, str(path)
        if is_depth(path):
            return _seen(label, sight_of_depth(read_depth(path, seen_by), seen_by, scale, origin))
        geometry = read_geometry(path)
    else:
        geometry, label, origin = geometry_in_memory(source), name or "scene", "the given scene"
        if isinstance(geometry, np.ndarray) and is_depth(geometry):
            return _seen(label, sight_of_depth(numbers(source), seen_by, scale, origin))
    if isinstance(geometry, trimesh.Trimesh):
        if seen_by is not None:
            raise ObjectError(f"{origin} is a mesh, and no camera sees one; give its cloud or depth image, or leave out the "
                              "camera")
        return _scaled(_of_mesh(label, geometry, origin, scale), scale, origin)
    seen = _seen(label, sight_of_cloud(coordinates(geometry, origin) * scale, seen_by, _shape(geometry)), origin)
    return _scaled(seen, scale, origin)


def _scaled(scene: Scene, scale: float, origin: str) -> Scene:
    """The scene, unless a scale below 1 makes it a speck: ObjectError."""
    extent = float(np.ptp(scene.points, axis=0).max())
    if scale < 1 and extent < SPECK:
        raise ObjectError(f"{origin} measures {extent * 1000:.3g} mm when it is scaled by {scale:g}, too little for a hand to "
                          "meet; give another scale, or leave it out")
    return scene


def _shape(cloud: Any) -> tuple[int, int] | None:
    """Height and width of an organised cloud."""
    return (cloud.shape[0], cloud.shape[1]) if cloud.ndim == 3 and cloud.shape[2] in (3, 6) else None


def _of_mesh(label: str, mesh: trimesh.Trimesh, origin: str, scale: float) -> Scene:
    points, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    if not len(faces) or faces.min() < 0 or faces.max() >= len(points) or not np.isfinite(points).all():
        raise ObjectError(f"{origin} has {len(faces)} faces, or vertices that are absent or not finite; repair the mesh, "
                          "or give a cloud")
    _check_coordinates(points * scale, origin)
    return Scene(label, points * scale, faces)


def _seen(label: str, sight: Sight, origin: str = "the depth image") -> Scene:
    _check_coordinates(sight.points, origin)
    points = sight.world()
    return Scene(label, points[one_per_cell(points, THIN)], None, sight)


def _check_coordinates(points: Float[np.ndarray, "n 3"], origin: str) -> None:
    if not len(points):
        raise ObjectError(f"{origin} holds no point: all are NaN or (0, 0, 0). Look from where the camera "
                          "measures depths, or leave obstacles out if nothing is to be avoided")
    far = np.abs(points).max(1) > FARTHEST
    if far.any():
        what_to_do = ("Give them as 0 or NaN if the camera measured nothing there" if far.mean() < 0.5 else
                      "Divide millimetres by 1000 (scale)")
        raise ObjectError(f"{origin} has coordinates of up to {np.abs(points).max():.3g} m: {far.sum()} of its {len(far)} "
                          f"points are farther away than {FARTHEST:g} m. {what_to_do}")


def _ball_distances(points: Float[np.ndarray, "n 3"]) -> Distance:
    """Distances to balls around points; they overlap those of their neighbours."""
    tree = search_tree(points)
    apart = tree.query(points, k=min(4, len(points)))[0][:, -1] if len(points) > 1 else np.zeros(1)
    radius = min(float(np.median(apart)) / 2, MARGIN / 3)
    return lambda places: tree.query(places)[0] - radius
