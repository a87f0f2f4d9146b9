"""The factorised, chunked kernel against the kernel written as the paper writes it."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from dro_grasp.network import distance_head
from dro_grasp.network.distance_head import DistanceHead, inverse_softplus


def naive_distances(head: DistanceHead, hand: Tensor, obj: Tensor) -> Tensor:
    """Every pair concatenated, in both orders, through the whole perceptron."""
    a = hand[:, :, None].expand(-1, -1, obj.shape[1], -1)
    b = obj[:, None].expand(-1, hand.shape[1], -1, -1)

    def perceptron(x: Tensor) -> Tensor:
        return head.last(head.second(head.first(x).relu()).relu())[..., 0]

    return functional.softplus(0.5 * (perceptron(torch.cat([a, b], -1)) + perceptron(torch.cat([b, a], -1))))


@pytest.fixture
def case() -> tuple[DistanceHead, Tensor, Tensor]:
    torch.manual_seed(0)
    head = DistanceHead(12, (10, 6), 0.1)
    return head, torch.randn(3, 20, 12, requires_grad=True), torch.randn(3, 15, 12, requires_grad=True)


@pytest.mark.parametrize("pairs", [1, 70, 700, 10_000], ids=lambda p: f"{p} pairs a chunk")
def test_equals_the_naive_kernel_with_its_gradients(
    case: tuple[DistanceHead, Tensor, Tensor], pairs: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(distance_head.PAIRS_PER_CHUNK, "cpu", pairs)
    head, hand, obj = case
    inputs, weight = [hand, obj, *head.parameters()], torch.randn(3, 20, 15)
    fast, slow = head(hand, obj), naive_distances(head, hand, obj)
    torch.testing.assert_close(fast, slow, rtol=1e-6, atol=1e-7)
    for ours, theirs in zip(
        torch.autograd.grad((fast * weight).sum(), inputs), torch.autograd.grad((slow * weight).sum(), inputs),
        strict=True,
    ):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)


def test_inference_equals_training(case: tuple[DistanceHead, Tensor, Tensor]) -> None:
    head, hand, obj = case
    trained = head(hand, obj)
    with torch.no_grad():
        inferred = head(hand, obj)
    assert trained.requires_grad
    assert not inferred.requires_grad
    assert torch.equal(inferred, trained)


def test_is_symmetric_and_positive_however_low_the_kernel(case: tuple[DistanceHead, Tensor, Tensor]) -> None:
    head, hand, obj = case
    torch.testing.assert_close(head(hand, obj), head(obj, hand).mT, rtol=1e-6, atol=1e-7)
    with torch.no_grad():
        head.last.bias -= 10
    low = head(hand, obj)
    assert 0 < low.min()
    assert low.max() < 1e-3, "the kernel itself is far below zero"


def test_untrained_kernel_predicts_the_initial_distance(case: tuple[DistanceHead, Tensor, Tensor]) -> None:
    head, hand, obj = case
    assert head(hand * 0, obj * 0).mean().item() == pytest.approx(0.1, abs=0.05)


def test_residual_of_a_silent_kernel_is_the_base(case: tuple[DistanceHead, Tensor, Tensor]) -> None:
    head, hand, obj = case
    with torch.no_grad():
        head.last.weight.zero_()
    base = torch.rand(3, 20, 15) * 0.3 + 1e-3
    torch.testing.assert_close(head(hand, obj, base), base, rtol=1e-4, atol=1e-6)


def test_half_precision_features_give_single_precision_distances(case: tuple[DistanceHead, Tensor, Tensor]) -> None:
    head, hand, obj = case
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rounded = head(hand, obj)
    assert rounded.dtype == torch.float32
    torch.testing.assert_close(rounded, head(hand, obj), rtol=0.05, atol=5e-3)


def test_inverse_softplus() -> None:
    x = torch.tensor([1e-3, 0.02, 0.5, 3.0, 30.0])
    torch.testing.assert_close(functional.softplus(inverse_softplus(x)), x, rtol=1e-4, atol=1e-7)
    assert torch.isfinite(inverse_softplus(torch.zeros(1))).all()
