"""What a hand that stands before an object sees of it: all of it, all of its points, the paper's half, or one depth image."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from jaxtyping import Float

from dro_grasp.objects.loading import cloud_object, estimate_normals
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.perception.camera import DepthCamera, visible_points
from dro_grasp.perception.completion import completed

View = Literal["whole", "cloud", "half", "depth"]
"""The mesh; all of the surface points, without the mesh; half of them; the points of a depth image."""
POINTS = 1024
"""Points of the paper's half of a cloud."""


def seen(obj: ObjectModel, view: View, seed: int, camera: DepthCamera | None = None) -> ObjectModel:
    """The object as it is seen: itself, or a bare cloud in its frame, to which the side that is not seen is added.

    Args:
        obj: An object with a mesh.
        view: `cloud` keeps all points and normals, to which nothing is added; `half` keeps the half of the points farthest
            along a random direction, as in the paper's appendix, and knows nothing of the camera; `depth` is one noisy depth
            image from a random direction, with normals towards the camera.
        seed: Of direction and noise.
        camera: Place and quality of the depth camera.
    """
    if view == "whole":
        return obj
    name = f"{obj.name}, {view} seen"
    if view == "cloud":
        return cloud_object(name, np.concatenate([obj.cloud, obj.cloud_normals], 1), origin=name)
    both = completed(*seen_side(obj, view, seed, camera))
    return cloud_object(name, np.concatenate([both.points, both.normals], 1), origin=name)


def seen_side(
    obj: ObjectModel, view: Literal["half", "depth"], seed: int, camera: DepthCamera | None = None
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, "3"] | None]:
    """What is seen alone: points [m], normals, and where the camera stands if that is known [m]; arguments as for `seen`."""
    generator = torch.Generator().manual_seed(seed)
    if view == "half":
        half = cloud_object(obj.name, obj.sample_partial(POINTS, generator).numpy(), origin=obj.name)
        return half.cloud.astype(np.float64), half.cloud_normals.astype(np.float64), None
    direction = torch.nn.functional.normalize(torch.randn(3, generator=generator), dim=0)
    camera = camera or DepthCamera()
    points = visible_points(obj, direction, generator, camera).numpy().astype(np.float64)
    place = camera.place(obj, direction)
    return points, estimate_normals(points.astype(np.float32), place).astype(np.float64), place
