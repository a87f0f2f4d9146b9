from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.distance import cdist

from dro_grasp.geometry.point_clouds import enclosed_volume, farthest_points, point_distances, random_half, sample_surface


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_each_next_point_is_farthest_from_all_before_it():
    points = torch.randn(3, 400, 3, generator=seeded())
    chosen = farthest_points(points, 40)
    for cloud, own in zip(points.double(), chosen, strict=True):
        apart = torch.cdist(cloud, cloud[own])
        for i in range(1, 40):
            assert int(apart[:, :i].amin(1).argmax()) == own[i]


def test_equally_far_points_are_chosen_in_their_order():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0]])
    assert farthest_points(points, 4).tolist() == [0, 1, 2, 3]


def test_farthest_points_start_and_shape():
    points = torch.randn(50, 3, generator=seeded())
    chosen = farthest_points(points, 50, start=7)
    assert chosen[0] == 7
    assert sorted(chosen.tolist()) == list(range(50))


def test_too_many_points_are_refused():
    with pytest.raises(ValueError, match="6 points were asked for, the cloud has 5"):
        farthest_points(torch.randn(5, 3), 6)


def test_samples_lie_on_their_faces_in_proportion_to_area():
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 3]])
    faces = torch.tensor([[0, 1, 2], [0, 3, 1]])
    points, normals, face = sample_surface(vertices, faces, 20000, seeded())
    share = float((face == 1).float().mean())
    assert abs(share - 0.75) < 0.015  # areas 0.5 and 1.5
    offset = ((points - vertices[faces[face, 0]]) * normals).sum(-1)
    assert offset.abs().max() < 1e-6  # [m]
    inside = points[face == 0]
    assert (inside[:, :2] >= -1e-6).all()
    assert (inside[:, :2].sum(-1) <= 1 + 1e-6).all()
    np.testing.assert_allclose(inside.mean(0), [1 / 3, 1 / 3, 0], atol=0.015)
    np.testing.assert_allclose(normals[face == 0].mean(0), [0, 0, 1], atol=1e-5)


def test_the_seed_fixes_the_sample():
    vertices, faces = torch.randn(20, 3, generator=seeded()), torch.randint(20, (30, 3), generator=seeded(1))
    first = sample_surface(vertices, faces, 100, seeded(5))
    second = sample_surface(vertices, faces, 100, seeded(5))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize("faces", [torch.empty(0, 3, dtype=torch.int64), torch.tensor([[0, 1, 1]])])
def test_a_mesh_without_area_is_refused(faces):
    with pytest.raises(ValueError, match="no area"):
        sample_surface(torch.eye(3), faces, 10, seeded())


def test_a_random_half_is_a_half_space_of_its_draw():
    points = torch.randn(400, 3, generator=seeded())
    kept = random_half(points, 200, seeded(3))
    assert len(kept.unique()) == 200
    rest = torch.tensor(sorted(set(range(400)) - set(kept.tolist())))
    normal = points[kept].mean(0) - points[rest].mean(0)
    generator = seeded(3)
    torch.randperm(400, generator=generator)
    direction = torch.randn(3, generator=generator)
    assert (points[kept] @ direction).min() >= (points[rest] @ direction).max()
    assert normal @ direction > 0


def test_a_small_cloud_has_no_random_half():
    with pytest.raises(ValueError, match="needs a cloud of 20 points, got 19"):
        random_half(torch.randn(19, 3), 10, seeded())


@pytest.mark.parametrize(("mesh", "volume"), [
    (trimesh.creation.box((0.1, 0.2, 0.3)), 0.006),
    (trimesh.creation.icosphere(5, 0.05), 4 / 3 * math.pi * 0.05**3),
    (trimesh.creation.torus(0.1, 0.02, 256, 128), 2 * math.pi**2 * 0.1 * 0.02**2),
], ids=["box", "sphere", "torus"])
def test_volumes_are_those_of_formulas_wherever_the_surface_is(mesh: trimesh.Trimesh, volume: float) -> None:
    triangles = np.asarray(mesh.triangles) + np.array([0.3, -2.0, 0.7])
    assert enclosed_volume(triangles) == pytest.approx(volume, rel=2e-3)
    assert enclosed_volume(triangles[:, ::-1]) == pytest.approx(-volume, rel=2e-3)


def test_distances_keep_their_digits_far_from_the_origin_and_have_a_gradient_where_points_meet() -> None:
    a = (torch.randn(30, 3, generator=torch.Generator().manual_seed(0)) * 0.05 + 10).requires_grad_()
    b = torch.cat([a.detach()[:5], torch.randn(30, 3, generator=torch.Generator().manual_seed(1)) * 0.05 + 10])
    found = point_distances(a, b)
    np.testing.assert_allclose(found.detach(), cdist(a.detach().double(), b.double()), atol=1e-6)
    found.sum().backward()
    assert a.grad is not None
    assert bool(a.grad.isfinite().all())
