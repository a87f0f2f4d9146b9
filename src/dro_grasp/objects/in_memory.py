"""Objects from what a program already holds: a mesh of trimesh, vertices and faces, or points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Num, Shaped
from torch import Tensor

from dro_grasp.errors import ObjectError
from dro_grasp.objects.loading import cloud_object, merge_scene, mesh_object
from dro_grasp.objects.shape import ObjectModel

ObjectSource = (
    str | Path | trimesh.Trimesh | trimesh.PointCloud | trimesh.Scene | tuple[Any, Any] | Num[np.ndarray, "..."]
    | Num[Tensor, "..."]
)
"""What an object can be loaded from: its name or file, a mesh, a pair (vertices, faces), or points."""
ORIGIN = "the given object"
"""What messages call it."""


def object_in_memory(source: Any, scale: float = 1.0, keep_table: bool = False) -> ObjectModel:
    """An object from a trimesh mesh, cloud or scene, from (vertices, faces), or from points (n 3) or with normals (n 6).

    Raises:
        ObjectError: It is none of these, or unusable.
    """
    geometry, unit = geometry_in_memory(source)
    if isinstance(geometry, trimesh.Trimesh):
        return mesh_object("mesh", geometry, origin=ORIGIN, scale=scale * unit)
    return cloud_object("cloud", geometry, origin=ORIGIN, scale=scale * unit, keep_table=keep_table)


def geometry_in_memory(source: Any) -> tuple[trimesh.Trimesh | Float[np.ndarray, "..."], float]:
    """One mesh, scenes merged, or points; and their unit [m], 1 where none is stated.

    Raises:
        ObjectError: It is no geometry.
    """
    if isinstance(source, trimesh.Trimesh | trimesh.PointCloud | trimesh.Scene):
        unit = trimesh.units.unit_conversion(source.units, "meters") if source.units else 1.0
        geometry = merge_scene(source) if isinstance(source, trimesh.Scene) else source
        return (np.asarray(geometry.vertices, np.float64) if isinstance(geometry, trimesh.PointCloud) else geometry), unit
    if isinstance(source, tuple) and len(source) == 2:
        vertices, faces = numbers(source[0]), numbers(source[1])
        for what, array in (("vertices", vertices), ("faces", faces)):
            if array.ndim != 2 or array.shape[1] != 3:
                raise ObjectError(f"the {what} have shape {array.shape}; expected (n, 3)")
        if faces.dtype.kind not in "iu":
            raise ObjectError(f"the faces are numbers of type {faces.dtype}; give the indices of their vertices as integers")
        return trimesh.Trimesh(vertices, faces, process=False), 1.0
    if isinstance(source, np.ndarray | Tensor):
        return numbers(source).astype(np.float64), 1.0
    raise ObjectError(f"an object cannot be loaded from a {type(source).__name__}; give a name, the path of a mesh or cloud, a "
                      "trimesh mesh, a pair (vertices, faces), or an array of points (n, 3)")


def numbers(values: Any, origin: str = ORIGIN, kinds: str = "iuf") -> Shaped[np.ndarray, "..."]:
    """An array of numbers from an array, a tensor or nested lists; `kinds` has NumPy's letters for the types that are taken.

    Raises:
        ObjectError: The values are none.
    """
    try:
        array = np.asarray(values.detach().cpu() if isinstance(values, Tensor) else values)
    except (TypeError, ValueError) as error:
        raise ObjectError(f"{origin} is no array of numbers ({error}); give one whose rows have equal lengths") from error
    if array.dtype.kind not in kinds:
        raise ObjectError(f"{origin} holds {array.dtype} instead of numbers; give arrays of floats, and of integers for faces")
    return array
