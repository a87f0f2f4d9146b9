"""Bare clouds of known shapes."""

from __future__ import annotations

import numpy as np
import trimesh

from dro_grasp.objects.loading import cloud_object
from dro_grasp.objects.shape import ObjectModel


def cloud_of(mesh: trimesh.Trimesh, name: str, points: int = 6000) -> ObjectModel:
    """Points of a mesh's surface with its normals."""
    places, face = trimesh.sample.sample_surface_even(mesh, points, seed=0)
    return cloud_object(name, np.concatenate([places, mesh.face_normals[face]], 1), origin=name, keep_table=True)
