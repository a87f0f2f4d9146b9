from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from dro_grasp.geometry.se3 import (
    apply,
    apply_to_cloud,
    compose,
    invert,
    random_rotations,
    register,
    roma,
    rotate,
    rotation_between,
)


def poses(n: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    rotation = random_rotations(n, generator, torch.float64)
    return compose(rotation, torch.randn(n, 3, generator=generator, dtype=torch.float64))


def test_poses_act_as_scipy_and_numpy_say() -> None:
    T, points = poses(20), torch.randn(20, 3, dtype=torch.float64)
    rotation = Rotation.from_matrix(T[:, :3, :3].numpy())
    np.testing.assert_allclose(rotate(T[:, :3, :3], points), rotation.apply(points.numpy()), atol=1e-14)
    np.testing.assert_allclose(apply(T, points), rotation.apply(points.numpy()) + T[:, :3, 3].numpy(), atol=1e-14)
    np.testing.assert_allclose(invert(T), np.linalg.inv(T.numpy()), atol=1e-14)


def test_inverses_and_products_form_a_group() -> None:
    a, b, points = poses(20, 0), poses(20, 1), torch.randn(20, 3, dtype=torch.float64)
    identity = torch.eye(4, dtype=torch.float64).expand(20, 4, 4)
    torch.testing.assert_close(invert(a) @ a, identity)
    torch.testing.assert_close(a @ invert(a), identity)
    torch.testing.assert_close(invert(a @ b), invert(b) @ invert(a))
    torch.testing.assert_close(apply(a @ b, points), apply(a, apply(b, points)))


def test_batches_broadcast() -> None:
    T, cloud = poses(4), torch.randn(4, 7, 3, dtype=torch.float64)
    torch.testing.assert_close(apply_to_cloud(T, cloud), apply(T[:, None], cloud))
    torch.testing.assert_close(apply_to_cloud(T, cloud[0]), apply(T[:, None], cloud[0]))
    assert apply(T[0], cloud[0, 0]).shape == (3,)
    torch.testing.assert_close(compose(T[:, None, :3, :3], cloud)[..., :3, 3], cloud)
    torch.testing.assert_close(compose(T[0, :3, :3], T[0, :3, 3]), T[0])


def test_gradients_flow_through_a_pose() -> None:
    T = poses(2).requires_grad_()
    points = torch.randn(2, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda T, p: apply(invert(T), p), (T, points))


def test_random_rotations_are_uniform() -> None:
    rotation = random_rotations(4000, torch.Generator().manual_seed(0), torch.float64).numpy()
    np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), np.broadcast_to(np.eye(3), rotation.shape), atol=1e-12)
    assert (np.linalg.det(rotation) > 0).all()
    # Under the uniform (Haar) measure the angle has density (1 - cos) / pi, and each entry is uniform on [-1, 1].
    angle = Rotation.from_matrix(rotation).magnitude()
    assert kstest(angle, lambda x: (x - np.sin(x)) / math.pi).pvalue > 1e-3
    assert all(kstest(rotation[:, i, j], "uniform", (-1, 2)).pvalue > 1e-3 for i in range(3) for j in range(3))


def test_random_rotations_repeat_with_the_generator() -> None:
    first, second = (random_rotations(5, torch.Generator().manual_seed(3)) for _ in range(2))
    assert torch.equal(first, second)
    assert first.dtype == torch.float32


@pytest.mark.parametrize("angle", [0.0, 1e-7, 1e-3, 1.0, math.pi - 1e-3, math.pi - 1e-7, math.pi])
def test_rotation_between_turns_one_vector_into_the_other(angle: float) -> None:
    a = torch.nn.functional.normalize(torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64), dim=0)
    across = torch.nn.functional.normalize(torch.linalg.cross(a, torch.tensor([0.0, 0.0, 1.0]).double()), dim=0)
    b = math.cos(angle) * a + math.sin(angle) * across
    turn = rotation_between(a, b)
    torch.testing.assert_close(rotate(turn, a), b, atol=2e-6, rtol=0)
    torch.testing.assert_close(turn.det(), torch.ones((), dtype=torch.float64))
    assert Rotation.from_matrix(turn.numpy()).magnitude() == pytest.approx(angle, abs=1e-9)


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
