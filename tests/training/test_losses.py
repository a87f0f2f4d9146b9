"""Losses against loops written from the paper, SciPy's rotations, torch.distributions, and finite differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.distributions import Normal, kl_divergence

from dro_grasp.training.losses import (
    contrastive_loss,
    distance_loss,
    divergence,
    divergence_loss,
    penetration_loss,
    placement_loss,
    pose_loss,
)

ALL = torch.tensor([True])


@pytest.fixture(autouse=True)
def seeded() -> None:
    torch.manual_seed(0)


def poses(rotations: Rotation, shape: tuple[int, ...]) -> Tensor:
    T = torch.eye(4, dtype=torch.float64).repeat(*shape, 1, 1)
    T[..., :3, :3] = torch.from_numpy(rotations.as_matrix()).view(*shape, 3, 3)
    T[..., :3, 3] = torch.randn(*shape, 3, dtype=torch.float64)
    return T


def sphere(count: int, radius: float) -> tuple[Tensor, Tensor]:
    """An even spiral of points, and their normals."""
    z = 1 - (2 * torch.arange(count) + 1) / count
    angle = torch.arange(count) * math.pi * (3 - math.sqrt(5))
    ring = (1 - z.square()).sqrt()
    normals = torch.stack([ring * angle.cos(), ring * angle.sin(), z], -1)
    return (normals * radius)[None], normals[None]


def test_distance_loss_is_the_mean_absolute_error() -> None:
    a, b = torch.randn(2, 2, 3, 4)
    assert float(distance_loss(a, b)) == pytest.approx(np.abs(a.numpy() - b.numpy()).mean(), rel=1e-6)


def test_pose_loss_equals_scipys_angles() -> None:
    predicted, true = Rotation.random(6, rng=0), Rotation.random(6, rng=1)
    a, b = poses(predicted, (2, 3)), poses(true, (2, 3))
    angles = (predicted.inv() * true).magnitude().reshape(2, 3)
    shifts = np.linalg.norm((a - b)[..., :3, 3].numpy(), axis=-1)
    valid = torch.tensor([True, False, True])
    np.testing.assert_allclose(pose_loss(a, b, valid), (angles + shifts)[:, [0, 2]].mean(1), rtol=1e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-4, math.pi / 2, math.pi - 1e-3])
def test_pose_loss_is_right_and_has_a_gradient_at_any_angle(angle: float) -> None:
    true = poses(Rotation.random(1, rng=0), (1, 1)).float()
    turned = true.clone()
    turned[0, 0, :3, :3] = true[0, 0, :3, :3] @ torch.from_numpy(Rotation.from_rotvec([0, angle, 0]).as_matrix()).float()
    turned.requires_grad_()
    loss = pose_loss(turned, true, torch.tensor([True]))
    loss.sum().backward()
    assert float(loss.detach()) == pytest.approx(angle, abs=5e-6)
    assert turned.grad is not None
    assert bool(turned.grad.isfinite().all())


def test_penetration_of_a_sphere_is_the_mean_depth() -> None:
    obj, normals = sphere(20_000, 0.05)
    radii = torch.tensor([0.03, 0.045, 0.049, 0.051, 0.07])
    hand = torch.nn.functional.normalize(torch.randn(1, 5, 3), dim=-1) * radii[:, None]
    expected = float((0.05 - radii).clamp(min=0).mean())
    assert float(penetration_loss(hand, obj, normals, ALL)) == pytest.approx(expected, abs=2e-5)  # [m]
    assert float(penetration_loss(hand * 3, obj, normals, ALL)) == 0


def test_penetration_equals_a_loop() -> None:
    hand, obj = torch.randn(2, 7, 3), torch.randn(2, 9, 3)
    normals = torch.nn.functional.normalize(torch.randn(2, 9, 3), dim=-1)
    expected = []
    for b in range(2):
        depth = 0.0
        for point in hand[b]:
            j = int((obj[b] - point).norm(dim=-1).argmin())
            depth += max(0.0, -float((point - obj[b, j]) @ normals[b, j]))
        expected.append(depth / 7)
    np.testing.assert_allclose(penetration_loss(hand, obj, normals, ALL), expected, rtol=1e-5)


def test_divergence_equals_pytorchs() -> None:
    mean, log_variance = torch.randn(2, 3, 5)
    posterior = Normal(mean, (0.5 * log_variance).exp())
    standard = kl_divergence(posterior, Normal(0.0, 1.0))
    torch.testing.assert_close(divergence(mean, log_variance), standard, rtol=1e-5, atol=1e-6)


def test_forms_of_the_divergence_loss() -> None:
    nats = torch.tensor([[0.5, 0.0, 3.0], [0.1, 0.2, 1.0]])
    assert float(divergence_loss(nats, "batch_mean")) == pytest.approx(float(nats.sum()) / 2)
    assert float(divergence_loss(nats, "official")) == pytest.approx(math.sqrt(1 + 4.8**2) - 1)
    assert float(divergence_loss(torch.zeros(2, 3), "official")) == 0


def naive_contrastive(a: np.ndarray, b: np.ndarray, p: np.ndarray, temperature: float, sharpness: float) -> float:
    """The paper's double sum for one pair of clouds."""
    def cosine(x: np.ndarray, y: np.ndarray) -> float:
        return x @ y / np.linalg.norm(x) / np.linalg.norm(y)

    n, total = len(a), 0.0
    largest = max(math.tanh(sharpness * np.linalg.norm(p[i] - p[j])) for i in range(n) for j in range(n))
    for i in range(n):
        below = 0.0
        for j in range(n):
            weight = 1.0 if i == j else math.tanh(sharpness * np.linalg.norm(p[i] - p[j])) / largest
            below += weight * math.exp(cosine(a[i], b[j]) / temperature)
        total -= math.log(math.exp(cosine(a[i], b[i]) / temperature) / below)
    return total / n


def test_contrastive_loss_equals_the_papers_double_sum() -> None:
    a, b, p = torch.randn(2, 11, 6), torch.randn(2, 11, 6), torch.randn(2, 11, 3) * 0.05
    p[0, 1] = p[0, 0]  # points that coincide do not repel
    expected = [naive_contrastive(*(x[i].double().numpy() for x in (a, b, p)), 0.1, 10.0) for i in range(2)]
    np.testing.assert_allclose(contrastive_loss(a, b, p, 0.1, 10.0), expected, rtol=1e-5)


def test_placement_loss_is_likelihood_and_cross_entropy() -> None:
    density, score, other = torch.randn(3, 6)
    label = torch.nn.functional.binary_cross_entropy_with_logits
    expected = -density.mean() + label(score, torch.ones(6)) + label(other, torch.zeros(6))
    torch.testing.assert_close(placement_loss(density, score, other), expected)


def test_gradients_equal_finite_differences() -> None:
    double = {"dtype": torch.float64}
    true = poses(Rotation.random(4, rng=1), (2, 2))
    moved = poses(Rotation.random(4, rng=2), (2, 2)).requires_grad_()
    assert torch.autograd.gradcheck(lambda T: pose_loss(T, true, torch.ones(2, dtype=torch.bool)), [moved])
    obj, normals = torch.randn(2, 1, 9, 3, **double)
    hand = torch.randn(1, 5, 3, **double, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: penetration_loss(x, obj, normals, ALL), [hand])
    a, b = (torch.randn(1, 5, 4, **double, requires_grad=True) for _ in range(2))
    p = torch.randn(1, 5, 3, **double)
    assert torch.autograd.gradcheck(lambda x, y: contrastive_loss(x, y, p, 0.5, 2.0), [a, b])
