"""What a hand that stands before an object sees of it: all, the paper's half, or one depth image."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch

from dro_grasp.objects.camera import DepthCamera, visible_points
from dro_grasp.objects.loading import cloud_object, estimate_normals
from dro_grasp.objects.scan import completed
from dro_grasp.objects.shape import ObjectModel

View = Literal["whole", "half", "depth"]
"""The mesh; half of the surface points; the points of a depth image."""
POINTS = 1024
"""Points of the paper's half of a cloud."""


def seen(obj: ObjectModel, view: View, seed: int, camera: DepthCamera | None = None) -> ObjectModel:
    """The object as it is seen: itself, or a bare cloud in its frame.

    Args:
        obj: An object with a mesh.
        view: `half` keeps the half of the points farthest along a random direction, as in the paper's appendix, and knows
            nothing of the camera; `depth` is one noisy depth image from a random direction, with normals towards the camera.
            The side that is not seen is added as a mirror image.
        seed: Of direction and noise.
        camera: Place and quality of the depth camera.
    """
    if view == "whole":
        return obj
    generator, towards = torch.Generator().manual_seed(seed), None
    name = f"{obj.name}, {view} seen"
    if view == "half":
        half = cloud_object(name, obj.sample_partial(POINTS, generator).numpy(), origin=name)
        points, normals = half.cloud, half.cloud_normals
    else:
        direction = torch.nn.functional.normalize(torch.randn(3, generator=generator), dim=0)
        towards = direction.numpy().astype(np.float64)
        points = visible_points(obj, direction, generator, camera).numpy()
        normals = estimate_normals(points)
        normals *= np.where(normals @ towards < 0, -1.0, 1.0)[:, None].astype(np.float32)
    both = completed(points.astype(np.float64), normals.astype(np.float64), towards)
    return cloud_object(name, np.concatenate(both, 1), origin=name)
