"""What a camera saw, on a page: points in colours that say what they were taken for, labels, and what a click hits."""

from __future__ import annotations

import math

import numpy as np
import viser
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from dro_grasp.apps.viewer.scene_view import Client, beside_ray, rgb
from dro_grasp.geometry.point_clouds import one_per_cell
from dro_grasp.geometry.point_groups import local_normals
from dro_grasp.geometry.rendering.rasterizer import OBJECT_COLOUR, Camera, Colour
from dro_grasp.objects.perception.choosing import Chosen
from dro_grasp.objects.perception.segmentation import STRUCTURE
from dro_grasp.objects.scenery import Scene
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.pictures.scene import OBSTACLE_COLOUR, STRAY_COLOUR, STRUCTURE_COLOUR, upward

CELL = 0.003  # Edge of the cubes of which one point each is drawn [m] (ours)
MOST = 120_000  # Most points that are drawn (ours)
POINT = 0.0032  # Least size of a drawn point [m]
LARGEST_POINT = 0.02  # Largest such size [m]
GUESSED_COLOUR: Colour = (0.98, 0.78, 0.52)  # Pale orange of what was not seen, but is likely there
NEIGHBOURS = 24  # Points of which normals are found (ours)
DARK = 0.45  # Brightness of what no light reaches [1] (ours)
CONE = 0.012  # Angle around the ray of a click within which points are hit [rad] (ours): some seven pixels
DEEP = 0.03  # Depth of what is hit, behind its nearest point [m] (ours)
MARGIN = 0.25  # Distance from the things up to which the rest is in the first view [m] (ours)
ELEVATION = 0.75  # Highest angle of views above the plane on which things stand [rad] (ours)
LEGEND = (("thing", OBSTACLE_COLOUR), ("chosen", OBJECT_COLOUR), ("its unseen side, estimated", GUESSED_COLOUR),
          ("table, wall, board", STRUCTURE_COLOUR), ("unknown: too small, large or far", STRAY_COLOUR))
"""What the colours mean."""


class SceneCloud:
    """The points of a scene, and the one thing that is chosen."""

    def __init__(self, client: Client, scene: Scene) -> None:
        """Show a scene in the place of another one.

        Raises:
            ObjectError: It is a mesh.
        """
        self._client, self.scene, self.labels = client, scene, scene.segments.labels
        assert scene.sight is not None
        self.world = scene.sight.world()
        rows = np.sort(one_per_cell(self.world, CELL))
        self._rows = rows[:: -(-len(rows) // MOST)]
        self.up = upward(scene)
        self.point = point_size(self.world[self._rows])
        self._shade = np.ones(len(self.world))
        self._shade[self._rows] = shades(local_normals(self.world[self._rows], NEIGHBOURS), np.asarray(self.up))
        client.scene.set_up_direction(self.up)
        client.scene.remove_by_name("/scene")
        self._points: list[viser.PointCloudHandle] = []
        self._movable: viser.FrameHandle | None = None
        self.colour(None, None)

    def colour(self, number: int | None, chosen: Chosen | None, obj: ObjectModel | None = None) -> None:
        """Show which thing is chosen, by its number and, once that is known, its points and all of its surface."""
        scene, rows, mine = self._client.scene, self._rows, np.zeros(len(self.labels), bool)
        mine[self.labels == number if chosen is None else chosen.own] = number is not None
        with self._client.atomic():
            scene.remove_by_name("/scene")
            self._movable = scene.add_frame("/scene/chosen", show_axes=False)
            rest = rows[~mine[rows]]
            self._cloud("rest", self.world[rest], colours_of(self.labels[rest]), self._shade[rest])
            if mine.any():
                own = rows[mine[rows]]
                self._cloud("chosen/seen", self.world[own], np.tile(rgb(OBJECT_COLOUR), (len(own), 1)), self._shade[own])
            if obj is not None:
                guess = obj.guessed > 0
                shade = shades(obj.cloud_normals[guess].astype(np.float64), np.asarray(self.up))
                self._cloud("chosen/guessed", obj.cloud[guess], np.tile(rgb(GUESSED_COLOUR), (len(shade), 1)), shade)
            for k in range(self.scene.segments.count):
                if k != number or obj is None:  # a hand comes there
                    scene.add_label(f"/scene/label{k}", f"{k + 1}", position=self.top_of(k))

    def _cloud(
        self, name: str, points: Float[np.ndarray, "n 3"], colours: Int[np.ndarray, "n 3"], shade: Float[np.ndarray, " n"]
    ) -> None:
        if len(points):
            self._client.scene.add_point_cloud(
                f"/scene/{name}", points.astype(np.float32), (colours * shade[:, None]).astype(np.uint8), point_size=self.point,
                point_shape="circle", precision="float32")

    @property
    def movable(self) -> viser.FrameHandle:
        """The frame that carries the chosen thing."""
        assert self._movable is not None
        return self._movable

    def top_of(self, number: int) -> tuple[float, float, float]:
        """A place just above a thing [m]."""
        own, up = self.world[self.labels == number], np.asarray(self.up) / np.linalg.norm(self.up)
        heights = own @ up
        x, y, z = np.median(own, axis=0) + (heights.max() - np.median(heights) + 0.015) * up
        return float(x), float(y), float(z)

    def hit(self, origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"]) -> int | None:
        """The point that a ray meets first, by its index in the scene; None for none."""
        found = first_hit(self.world[self._rows], origin, direction)
        return None if found is None else int(self._rows[found])

    def camera(self) -> Camera:
        """A view on all things, and what is beside them."""
        things = self.world[self.labels >= 0]
        points = self.world[self._rows]
        if len(things):
            low, high = things.min(0) - MARGIN, things.max(0) + MARGIN
            points = points[((points > low) & (points < high)).all(1)]
        return self.view_of(points)

    def view_of(self, points: Float[np.ndarray, "n 3"]) -> Camera:
        """A view on points, from the side from which the camera saw them, but not as steep [m]."""
        sight, up = self.scene.sight, np.asarray(self.up) / np.linalg.norm(self.up)
        assert sight is not None
        eye = sight.T[:3, 3] if sight.from_camera else points.mean(0) + np.array([0.5, -1.0, 0.8])
        towards = eye - self.world[self._rows].mean(0)
        flat, height = towards - towards @ up * up, float(towards @ up)
        across = float(np.linalg.norm(flat))
        flat = flat / across if across > 1e-6 else np.eye(3)[np.abs(up).argmin()]
        angle = min(math.atan2(height, across), ELEVATION)
        x, y, z = (math.cos(angle) * flat + math.sin(angle) * up).tolist()
        return Camera.around(points, (x, y, z), self.up, aspect=4 / 3)


def point_size(points: Float[np.ndarray, "n 3"]) -> float:
    """Size at which neighbours of a cloud overlap [m]; rooms are seen with points far apart."""
    some = points[:: max(1, len(points) // 2000)]
    apart = float(np.median(KDTree(points).query(some, k=2)[0][:, 1])) if len(points) > 1 else 0.0
    return min(max(POINT, 1.3 * apart), LARGEST_POINT)


def shades(normals: Float[np.ndarray, "n 3"], up: Float[np.ndarray, "3"]) -> Float[np.ndarray, " n"]:
    """How bright surfaces are in light from above and from aside, whichever side their normals point to."""
    lights = np.stack([up, np.cross(up, np.eye(3)[np.abs(up).argmin()])])
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    above, aside = np.abs(lights @ normals.T)
    return np.clip(DARK + (1 - DARK) * (above + 0.35 * aside), 0.0, 1.0)


def colours_of(labels: Int[np.ndarray, " n"]) -> Int[np.ndarray, "n 3"]:
    """Colours of points by what they were taken for, to 255."""
    colours = np.tile(rgb(STRAY_COLOUR), (len(labels), 1))
    colours[labels == STRUCTURE] = rgb(STRUCTURE_COLOUR)
    colours[labels >= 0] = rgb(OBSTACLE_COLOUR)
    return colours


def first_hit(
    points: Float[np.ndarray, "n 3"], origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"], cone: float = CONE
) -> int | None:
    """The point within a narrow cone around a ray that is met first; None where there is none.

    Points are no surface: of those that are met at about the same depth, the one nearest to the ray is taken.
    """
    if not len(points) or not np.isfinite([*origin, *direction]).all() or not np.linalg.norm(direction):
        return None
    depth, aside = beside_ray(points, origin, direction)
    met = np.flatnonzero((depth > 0) & (aside < cone * depth))
    if not len(met):
        return None
    near = met[depth[met] < depth[met].min() + DEEP]
    return int(near[aside[near].argmin()])
