from __future__ import annotations

import numpy as np
import pytest
import torch

from dro_grasp.geometry.signed_distance import SignedDistanceGrid

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


def bake(shape) -> SignedDistanceGrid:
    axis = torch.arange(-HALF, HALF + 1e-6, SPACING)
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return SignedDistanceGrid.from_values(shape(points), torch.full((3,), -HALF), SPACING)


@pytest.mark.parametrize("shape", [sphere, box, cylinder])
def test_value_agrees_with_the_analytic_shape(shape):
    points = (torch.rand(4, 500, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1) * (HALF - SPACING)
    value, _ = bake(shape).query(points)
    error = (value - shape(points)).abs()
    assert error.max() < 0.5 * SPACING  # [m], at edges and on the medial axis
    assert error.median() < 1e-4  # [m]


def test_gradient_points_away_from_the_sphere():
    points = torch.randn(300, 3, generator=torch.Generator().manual_seed(1))
    points = points / points.norm(dim=-1, keepdim=True) * torch.linspace(0.02, 0.08, 300)[:, None]
    _, gradient = bake(sphere).query(points)
    np.testing.assert_allclose(gradient, points / points.norm(dim=-1, keepdim=True), atol=0.1)


def test_autograd_of_the_value_is_the_returned_gradient():
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(2)).mul(0.08).requires_grad_()
    value, gradient = bake(cylinder).query(points)
    value.sum().backward()
    outside = (points.detach().abs() > HALF).any(-1)
    assert outside.any()
    assert points.grad.isfinite().all()
    np.testing.assert_allclose(points.grad[~outside], gradient.detach()[~outside], atol=1e-5)


def test_outside_the_grid_values_grow_and_never_understate():
    directions = torch.randn(100, 3, generator=torch.Generator().manual_seed(3))
    directions = directions / directions.norm(dim=-1, keepdim=True)
    near, far = directions * 0.2, directions * 0.4
    grid = bake(sphere)
    value_near, gradient = grid.query(near)
    value_far, _ = grid.query(far)
    assert (value_far > value_near + 0.15).all()
    assert (value_near >= sphere(near) - 1e-3).all()
    assert (value_near <= sphere(near) * 1.3 + 1e-3).all()
    assert ((gradient * directions).sum(-1) > 0.5).all()


def test_precision_and_device_follow():
    grid = bake(sphere).to(dtype=torch.float64)
    value, gradient = grid.query(torch.zeros(3, dtype=torch.float64) + 0.041)
    assert value.dtype == gradient.dtype == torch.float64
