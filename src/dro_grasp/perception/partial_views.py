"""Partial views of an object: its whole cloud, the paper's half of it, or one depth image."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from jaxtyping import Float

from dro_grasp.objects.loading import cloud_object, estimate_normals
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.perception.completion import complete_cloud
from dro_grasp.perception.depth_camera import DepthCamera, visible_points

View = Literal["whole", "cloud", "half", "depth"]
"""The mesh; all surface points without the mesh; half of them; the points of a depth image."""
POINTS = 1024
"""Points of the paper's half of a cloud (twice the network's 512 points)."""


def partial_view(obj: ObjectModel, view: View, seed: int, camera: DepthCamera | None = None) -> ObjectModel:
    """The object in a view: itself, or a bare cloud in its frame with the unseen side completed.

    Args:
        obj: An object with a mesh.
        view: `whole` is the object itself. `cloud` keeps all points and normals and completes nothing. `half` keeps the
            half of the points farthest along a random direction, as in the paper's appendix, without a camera. `depth` is
            one noisy depth image from a random direction.
    """
    if view == "whole":
        return obj
    name = f"{obj.name}, {view} seen"
    if view == "cloud":
        return cloud_object(name, np.concatenate([obj.cloud, obj.cloud_normals], 1), origin=name)
    both = complete_cloud(*visible_side(obj, view, seed, camera))
    return cloud_object(name, np.concatenate([both.points, both.normals], 1), origin=name)


def visible_side(
    obj: ObjectModel, view: Literal["half", "depth"], seed: int, camera: DepthCamera | None = None
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, "3"] | None]:
    """Points of the visible side alone [m], their normals, and the camera's position if there is one [m].

    Arguments are those of `partial_view`.
    """
    generator = torch.Generator().manual_seed(seed)
    if view == "half":
        half = cloud_object(obj.name, obj.sample_partial(POINTS, generator).numpy(), origin=obj.name)
        return half.cloud.astype(np.float64), half.cloud_normals.astype(np.float64), None
    direction = torch.nn.functional.normalize(torch.randn(3, generator=generator), dim=0)
    camera = camera or DepthCamera()
    points = visible_points(obj, direction, generator, camera).numpy().astype(np.float64)
    position = camera.place(obj, direction)
    return points, estimate_normals(points.astype(np.float32), position).astype(np.float64), position
