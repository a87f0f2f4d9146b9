"""Partial views of an object: its whole cloud, the paper's half of it, or the image of a depth camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull
from torch import Tensor

from dro_grasp.errors import OptionError
from dro_grasp.geometry.mesh_files import trimesh
from dro_grasp.kinds import Checked
from dro_grasp.network.completion_network import SurfaceNetwork
from dro_grasp.objects.loading import cloud_object, estimate_normals
from dro_grasp.objects.perception.completion import complete_cloud
from dro_grasp.objects.perception.depth_noise import DepthView, NoiseName, depth_noise, measured_depth
from dro_grasp.objects.reading import numbers
from dro_grasp.objects.shape import ObjectModel

View = Literal["whole", "cloud", "half", "depth"]
"""The mesh; all surface points without the mesh; half of them; the points of a depth image."""
POINTS = 1024  # Points of the paper's half of a cloud (twice the network's 512 points)


def partial_view(
    obj: ObjectModel, view: View, seed: int, camera: DepthCamera | None = None, network: SurfaceNetwork | None = None
) -> ObjectModel:
    """An object with a mesh in a view: itself, or a bare cloud in its frame with the unseen side completed.

    `whole` is the object itself. `cloud` keeps all points and normals and completes nothing. `half` keeps the half of the
    points farthest along a random direction, as in the paper's appendix, without a camera. `depth` is one noisy depth image
    from a random direction. The network completes it, by default the one that ships.
    """
    if view == "whole":
        return obj
    name = f"{obj.name}, {view} seen"
    if view == "cloud":
        return cloud_object(name, np.concatenate([obj.cloud, obj.cloud_normals], 1), origin=name, keep_table=True)
    seen, normals, place = visible_side(obj, view, seed, camera)
    both = complete_cloud(seen, normals, place, network=network)
    return cloud_object(
        name, np.concatenate([both.points, both.normals], 1), origin=name, keep_table=True,
        seen=seen if both.added.any() else None)


def visible_side(
    obj: ObjectModel, view: Literal["half", "depth"], seed: int, camera: DepthCamera | None = None
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, "3"] | None]:
    """As `partial_view`: the visible side's points alone [m], their normals, and the camera's position if there is one [m]."""
    generator = torch.Generator().manual_seed(seed)
    if view == "half":
        half = cloud_object(obj.name, obj.sample_partial(POINTS, generator).numpy(), origin=obj.name, keep_table=True)
        return half.cloud.astype(np.float64), half.cloud_normals.astype(np.float64), None
    direction = torch.nn.functional.normalize(torch.randn(3, generator=generator), dim=0)
    camera = camera or DepthCamera()
    points = visible_points(obj, direction, generator, camera).numpy().astype(np.float64)
    position = camera.place(obj, direction)
    return points, estimate_normals(points.astype(np.float32), position).astype(np.float64), position


@dataclass(frozen=True)
class DepthCamera(Checked):
    """A pinhole depth camera that looks at the middle of the object."""

    distance: float = 0.5
    """From the camera to the object's middle [m]."""
    pixel: float = 0.0015
    """Size of a pixel at that distance [m]; that of a 640-pixel camera with a field of view of 87 degrees."""
    noise: float | NoiseName = "stereo"
    """Noise of depth: that of a kind of camera, or its standard deviation at half a metre, which grows with the square of depth
    [m]. Of a bare cloud, which has no image, a kind of camera gives independent noise alone."""
    lost: float = 0.0
    """Share of pixels that return nothing."""
    grazing: float = 0.17
    """Rays at a smaller angle to the surface return nothing [rad]."""

    def __post_init__(self) -> None:
        """Refuse impossible settings."""
        super().__post_init__()
        depth_noise(self.noise)
        if min(self.distance, self.pixel) <= 0 or not 0 <= self.lost < 1:
            raise OptionError(f"{self} is no possible camera: distance and pixel must be positive, and lost at least 0 and "
                              "below 1")

    def place(self, obj: ObjectModel, direction: Float[Tensor, "3"]) -> Float[np.ndarray, "3"]:
        """Position in the object's frame for a view from a direction of any length [m]."""
        towards = direction.double().numpy()
        return _middle(obj) + self.distance * towards / np.linalg.norm(towards)


def visible_points(
    obj: ObjectModel, direction: ArrayLike, generator: torch.Generator, camera: DepthCamera | None = None
) -> Float[Tensor, "n 3"]:
    """Points of one depth image of the object, in the object's frame [m].

    Rays are cast at a mesh. Of a bare cloud, the visible points are those that no others hide.

    Args:
        obj: A mesh or a bare cloud.
        direction: From the object towards the camera, of any length: three numbers.
        generator: Draws noise and lost pixels.
        camera: The depth camera; the default one if omitted.

    Raises:
        OptionError: The direction has no length, or the camera stands inside the object.
    """
    camera = camera or DepthCamera()
    towards = 1.0 * torch.from_numpy(numbers(direction, "direction"))
    length = float(towards.norm())
    if towards.shape != (3,) or not np.isfinite(length) or length < 1e-9:
        raise OptionError(f"direction is {towards.tolist()}; give a vector from the object to the camera, as 0 0 1")
    low, high = obj.cloud.min(0).astype(np.float64), obj.cloud.max(0).astype(np.float64)
    radius = float(np.linalg.norm(high - low)) / 2
    if camera.distance <= radius:
        raise OptionError(f"a camera at {camera.distance:g} m is inside the object, {radius:.3g} m in radius; "
                          "move it away")
    T_object_camera = _looking_at(_middle(obj), towards.double().numpy() / length, camera.distance)
    hits = (_hits_of_cloud if obj.is_cloud else _hits_of_mesh)(obj, T_object_camera, radius, camera)
    kept = torch.rand(len(hits.depth), generator=generator).numpy() >= camera.lost
    measured = _measured(hits, camera, generator)
    points = (hits.rays * measured[:, None])[kept & (measured > 0)]
    return torch.from_numpy((points @ T_object_camera[:3, :3].T + T_object_camera[:3, 3]).astype(np.float32))


def _middle(obj: ObjectModel) -> Float[np.ndarray, "3"]:
    """Middle of the object's bounding box [m]."""
    return (obj.cloud.min(0).astype(np.float64) + obj.cloud.max(0)) / 2


def _looking_at(middle: Float[np.ndarray, "3"], towards: Float[np.ndarray, "3"], distance: float) -> Float[np.ndarray, "4 4"]:
    """Camera pose with z from the camera to the middle."""
    helper = np.eye(3)[np.abs(towards).argmin()]
    x = np.cross(helper, -towards)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(-towards, x), -towards], 1)
    pose[:3, 3] = middle + distance * towards
    return pose


class _Hits(NamedTuple):
    """Where rays meet an object, in the camera's frame."""

    rays: Float[np.ndarray, "n 3"]  # Directions with z = 1
    depth: Float[np.ndarray, " n"]  # Along z [m]
    normals: Float[np.ndarray, "n 3"]
    pixel: Int[np.ndarray, "2 n"]  # Row and column
    intrinsics: Float[np.ndarray, "3 3"] | None  # Of the image [pixels]; None if there is no image


def _measured(hits: _Hits, camera: DepthCamera, generator: torch.Generator) -> Float[np.ndarray, " n"]:
    """Depths with noise [m]; 0 where nothing is returned."""
    drawn = torch.randn(len(hits.depth), generator=generator).numpy()
    if not isinstance(camera.noise, str):
        return hits.depth + drawn * camera.noise * (hits.depth / 0.5) ** 2
    noise, seed = depth_noise(camera.noise), int(torch.randint(2**31, (), generator=generator))
    if hits.intrinsics is None:
        cosine = np.abs((hits.rays * hits.normals).sum(1)) / np.linalg.norm(hits.rays, axis=1)
        angle = np.arccos(np.clip(cosine, 0, 1))
        return np.where(angle < noise.steep[1], hits.depth + drawn * noise.deviation(hits.depth, angle), 0.0)
    row, column = hits.pixel
    image = np.zeros((int(row.max(initial=0)) + 1, int(column.max(initial=0)) + 1))
    normals = np.zeros((*image.shape, 3))
    image[row, column], normals[row, column] = hits.depth, hits.normals
    return measured_depth(DepthView(image, normals, hits.intrinsics), noise, seed)[row, column]


def _hits_of_mesh(
    obj: ObjectModel, T_object_camera: Float[np.ndarray, "4 4"], radius: float, camera: DepthCamera
) -> _Hits:
    """First hits of the rays of a square image."""
    mesh = trimesh.Trimesh(obj.vertices, obj.faces, process=False)
    # At the distance of its middle, a sphere's silhouette is wider than the sphere.
    reach = camera.distance * radius / np.sqrt(camera.distance**2 - radius**2)
    side = np.arange(-reach, reach + camera.pixel, camera.pixel) / camera.distance
    rays = np.stack([*np.meshgrid(side, side, indexing="ij"), np.ones((len(side), len(side)))], -1).reshape(-1, 3)
    rotation, place = T_object_camera[:3, :3], T_object_camera[:3, 3]
    towards = rays @ rotation.T
    hits, ray, face = mesh.ray.intersects_location(np.tile(place, (len(rays), 1)), towards, multiple_hits=False)
    cosine = np.abs((mesh.face_normals[face] * towards[ray]).sum(1)) / np.linalg.norm(towards[ray], axis=1)
    kept = cosine > np.sin(camera.grazing)
    focal = camera.distance / camera.pixel
    return _Hits(
        rays[ray[kept]], ((hits - place) @ rotation[:, 2])[kept], mesh.face_normals[face[kept]] @ rotation,
        np.stack([ray[kept] % len(side), ray[kept] // len(side)]),  # x is the first axis of the grid
        np.array([[focal, 0, -focal * side[0]], [0, focal, -focal * side[0]], [0, 0, 1]]))


def _hits_of_cloud(
    obj: ObjectModel, T_object_camera: Float[np.ndarray, "4 4"], radius: float, camera: DepthCamera
) -> _Hits:
    """The points that no others hide, without an image. Source: Katz, Tal and Basri 2007."""
    # Reflect every point in a sphere about the camera: it is visible exactly if its image lies on the convex hull of all images
    # and the camera.
    local = (obj.cloud.astype(np.float64) - T_object_camera[:3, 3]) @ T_object_camera[:3, :3]
    away = np.linalg.norm(local, axis=1, keepdims=True)
    radius = 300.0 * away.max()  # (ours): a larger sphere sees more, a smaller one hides more
    flipped = local + 2 * (radius - away) * local / away
    hull = ConvexHull(np.concatenate([flipped, np.zeros((1, 3))]), qhull_options="QJ").vertices
    seen = np.sort(hull[hull < len(local)])
    visible, normals = local[seen], obj.cloud_normals[seen].astype(np.float64) @ T_object_camera[:3, :3]
    return _Hits(visible / visible[:, 2:], visible[:, 2], normals, np.zeros((2, len(seen)), int), None)
