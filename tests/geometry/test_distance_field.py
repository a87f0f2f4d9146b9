from __future__ import annotations

import numpy as np
import pytest
import torch

from dro_grasp.geometry.distance_field import DistanceField, DistanceFields

SPACING = 0.003
HALF = 0.09


def sphere(p: torch.Tensor) -> torch.Tensor:
    return p.norm(dim=-1) - 0.04


def box(p: torch.Tensor) -> torch.Tensor:
    q = p.abs() - torch.tensor([0.05, 0.03, 0.02])
    return q.clamp(min=0).norm(dim=-1) + q.amax(-1).clamp(max=0)


def cylinder(p: torch.Tensor) -> torch.Tensor:
    q = torch.stack([p[..., :2].norm(dim=-1) - 0.03, p[..., 2].abs() - 0.05], -1)
    return q.clamp(min=0).norm(dim=-1) + q.amax(-1).clamp(max=0)


def bake(shape) -> DistanceField:
    axis = torch.arange(-HALF, HALF + 1e-6, SPACING)
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return DistanceField.from_values(shape(points), torch.full((3,), -HALF), SPACING)


@pytest.mark.parametrize("shape", [sphere, box, cylinder])
def test_value_agrees_with_the_analytic_shape(shape):
    points = (torch.rand(4, 500, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1) * (HALF - SPACING)
    value, _ = bake(shape).distances(points)
    error = (value - shape(points)).abs()
    assert error.max() < 0.5 * SPACING  # [m], at edges and on the medial axis
    assert error.median() < 1e-4  # [m]


def test_gradient_points_away_from_the_sphere():
    points = torch.randn(300, 3, generator=torch.Generator().manual_seed(1))
    points = points / points.norm(dim=-1, keepdim=True) * torch.linspace(0.02, 0.08, 300)[:, None]
    _, gradient = bake(sphere).distances(points)
    np.testing.assert_allclose(gradient, points / points.norm(dim=-1, keepdim=True), atol=0.1)


def test_autograd_of_the_value_is_the_returned_gradient():
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(2)).mul(0.08).requires_grad_()
    value, gradient = bake(cylinder).distances(points)
    value.sum().backward()
    outside = (points.detach().abs() > HALF).any(-1)
    assert outside.any()
    assert points.grad.isfinite().all()
    np.testing.assert_allclose(points.grad[~outside], gradient.detach()[~outside], atol=1e-5)


def test_outside_the_grid_values_grow_and_never_overstate():
    directions = torch.randn(100, 3, generator=torch.Generator().manual_seed(3))
    directions = directions / directions.norm(dim=-1, keepdim=True)
    near, far = directions * 0.2, directions * 0.4
    field = bake(sphere)
    value_near, gradient = field.distances(near)
    value_far, _ = field.distances(far)
    assert (value_far > value_near + 0.1).all()
    assert (value_near <= sphere(near) + 1e-3).all(), "a convex shape lies behind its tangent planes"
    assert (value_near > 0.7 * sphere(near)).all()
    assert ((gradient * directions).sum(-1) > 0.5).all()


def test_a_field_has_the_precision_of_its_values():
    axis = torch.linspace(-0.01, 0.01, 5, dtype=torch.float64)
    values = sphere(torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1))
    field = DistanceField.from_values(values, torch.full((3,), -0.01), 0.005)
    assert field.normals(torch.zeros(2, 3, dtype=torch.float64)).bend.dtype == torch.float64


def test_each_row_of_stacked_fields_sees_its_own():
    fields = [bake(shape) for shape in (sphere, box, cylinder)]
    points = 0.12 * torch.rand(6, 5, 2, 3, dtype=fields[0].slopes.dtype, generator=torch.Generator().manual_seed(0)) - 0.06
    stacked = DistanceFields.of([fields[0], fields[2], fields[0], fields[1]], [1, 2, 1, 2])
    order = [0, 2, 2, 0, 1, 1]
    assert len(stacked.slopes) == sum(len(field.slopes) for field in fields)
    for rows in (slice(None), slice(1, 5)):
        found = stacked.rows(rows).normals(points[rows])
        for k, i in enumerate(range(6)[rows]):
            for value, expected in zip(found, fields[order[i]].normals(points[i]), strict=True):
                torch.testing.assert_close(value[k], expected)
            distance, gradient = stacked.rows(rows).distances(points[rows])
            torch.testing.assert_close((distance[k], gradient[k]), fields[order[i]].distances(points[i]))
