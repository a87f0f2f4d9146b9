"""The volume inside a surface, against formulas."""

import math

import numpy as np
import pytest
import trimesh

from dro_grasp.geometry.triangles import enclosed_volume


@pytest.mark.parametrize(("mesh", "volume"), [
    (trimesh.creation.box((0.1, 0.2, 0.3)), 0.006),
    (trimesh.creation.icosphere(5, 0.05), 4 / 3 * math.pi * 0.05**3),
    (trimesh.creation.torus(0.1, 0.02, 256, 128), 2 * math.pi**2 * 0.1 * 0.02**2),
], ids=["box", "sphere", "torus"])
def test_volumes_are_those_of_formulas_wherever_the_surface_is(mesh: trimesh.Trimesh, volume: float) -> None:
    triangles = np.asarray(mesh.triangles) + np.array([0.3, -2.0, 0.7])
    assert enclosed_volume(triangles) == pytest.approx(volume, rel=2e-3)
    assert enclosed_volume(triangles[:, ::-1]) == pytest.approx(-volume, rel=2e-3)
