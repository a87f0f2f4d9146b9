from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from dro_grasp.geometry.registration import register
from dro_grasp.geometry.rotations import roma


def pair(batch: tuple[int, ...] = (), n: int = 20, noise: float = 0.0, dtype=torch.float64):
    torch.manual_seed(0)
    source = torch.randn(*batch, n, 3, dtype=dtype) * 0.02
    rotation, shift = roma.random_rotmat(batch or 1, dtype=dtype).reshape(*batch, 3, 3), torch.randn(*batch, 3, dtype=dtype)
    target = source @ rotation.mT + shift[..., None, :] + noise * torch.randn(*batch, n, 3, dtype=dtype)
    return source, target, rotation, shift


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_exact_motion_is_recovered(batch):
    source, target, rotation, shift = pair(batch)
    T, residual = register(source, target)
    np.testing.assert_allclose(T[..., :3, :3], rotation, atol=1e-7)
    np.testing.assert_allclose(T[..., :3, 3], shift, atol=1e-8)
    assert (residual < 1e-7).all()
    assert residual.shape == batch


def test_noisy_weighted_motion_agrees_with_scipy():
    source, target, _, _ = pair(noise=0.003)
    weights = torch.linspace(0.1, 2, 20, dtype=torch.float64)
    T, residual = register(source, target, weights)
    share = weights / weights.sum()
    a, b = source - share @ source, target - share @ target
    oracle, rssd = Rotation.align_vectors(b.numpy(), a.numpy(), weights=weights.numpy())
    rms = rssd / float(weights.sum().sqrt())
    np.testing.assert_allclose(T[:3, :3], oracle.as_matrix(), atol=1e-6)
    np.testing.assert_allclose(float(residual), rms, rtol=1e-5)


def test_zero_weights_leave_points_out():
    source, target, rotation, _ = pair()
    target[5:8] += 1.0
    weights = torch.ones(20, dtype=torch.float64)
    weights[5:8] = 0
    T, residual = register(source, target, weights)
    np.testing.assert_allclose(T[:3, :3], rotation, atol=1e-7)
    assert residual < 1e-7


def test_all_weights_zero_stay_finite():
    source, target, _, _ = pair((2,))
    T, _ = register(source, target, torch.zeros(2, 20, dtype=torch.float64))
    assert T.isfinite().all()


def test_mirrored_points_get_a_rotation_and_a_residual():
    source, _, _, _ = pair()
    T, residual = register(source, source * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
    np.testing.assert_allclose(torch.linalg.det(T[:3, :3]), 1, atol=1e-9)
    assert residual > 0.01


def test_gradient_agrees_with_finite_differences():
    source, target, _, _ = pair(n=6, noise=0.002)
    assert torch.autograd.gradcheck(lambda t: register(source, t)[0], target.requires_grad_(), atol=1e-6)
    assert torch.autograd.gradcheck(lambda t: register(source, t)[1], target, atol=1e-5)


@pytest.mark.parametrize("kind", ["exact", "planar", "collinear", "one point"])
def test_gradients_are_finite_on_thin_links(kind):
    source, _, rotation, shift = pair(dtype=torch.float32)
    scale = {"exact": (1, 1, 1), "planar": (1, 1, 0), "collinear": (1, 0, 0), "one point": (0, 0, 0)}[kind]
    source = source * torch.tensor(scale)
    target = (source @ rotation.mT + shift).requires_grad_()
    T, residual = register(source, target)
    (T.sum() + residual.sum()).backward()
    assert target.grad.isfinite().all()
    np.testing.assert_allclose(torch.linalg.det(T.detach()[:3, :3]), 1, atol=1e-4)
