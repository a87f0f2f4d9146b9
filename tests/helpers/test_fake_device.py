"""The fake device: whatever CUDA refuses it refuses, and correct code gets the CPU's numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from dro_grasp.devices import require_device
from tests.helpers.fake_device import DEVICE, fake_device
from tests.helpers.toy_hand import toy_hand

X = torch.linspace(-1, 2, 12).reshape(4, 3)
SQUARE = X.mT @ X + torch.eye(3)


@pytest.fixture(autouse=True)
def device() -> Iterator[str]:
    with fake_device() as name:
        yield name


REFUSED: dict[str, Callable[[Tensor], object]] = {
    "sum": lambda x: x + X,
    "sum with an array": lambda x: x + torch.from_numpy(np.ones((4, 3), np.float32)),
    "product": lambda x: x @ torch.eye(3),
    "product with a module on the CPU": lambda x: nn.Linear(3, 2)(x),
    "stack": lambda x: torch.stack([x, X]),
    "stack of scalars": lambda x: torch.stack([x[0, 0], X[0, 0]]),
    "choice": lambda x: torch.where(x > 0, x, torch.zeros(4, 3)),
    "values written": lambda x: x.clone().index_put_((torch.tensor([0]),), torch.zeros(1, 3)),
    "slice written": lambda x: torch.zeros(4, 3).add_(x),
    "scalar written": lambda x: torch.zeros(()).add_(x[0, 0]),
    "comparison with a tensor of many": lambda x: X > x[0, 0],
    "index of the device into the CPU": lambda x: X[x[:, 0] > 0],
    "gather": lambda x: x.gather(1, torch.zeros(4, 1, dtype=torch.long)),
    "generator of the CPU": lambda x: torch.rand(3, device=x.device, generator=torch.Generator()),
    "generator of the device": lambda x: torch.rand(3, generator=torch.Generator(x.device)),
    "interpolation": lambda x: torch.lerp(x, X, 0.5),
    "list of tensors": lambda x: torch._foreach_add([x], [X]),
}
"""Mixtures that CUDA refuses, by name."""


@pytest.mark.parametrize("case", REFUSED)
def test_mixing_devices_is_refused_as_by_cuda(device: str, case: str) -> None:
    REFUSED[case](X)  # the CPU alone can
    with pytest.raises(RuntimeError, match=r"same device|on cpu|for generator"):
        REFUSED[case](X.to(device))


def test_arrays_are_made_on_the_cpu_alone(device: str) -> None:
    for convert in (lambda x: x.numpy(), np.asarray, lambda x: np.linalg.norm(x)):
        with pytest.raises(TypeError, match=r"can't convert .* Use Tensor.cpu\(\)"):
            convert(X.to(device))
    assert np.array_equal(X.to(device).cpu().numpy(), X.numpy())


def branches(x: Tensor) -> Tensor:
    """Values read on the host decide what is computed."""
    assert bool((x[0] < 0).any())
    return x * float(x.amax()) + int(x.argmax()) if x.sum().item() > 0 else x


def indexed(x: Tensor) -> Tensor:
    """Indices of every kind, read and written."""
    x = x.clone()
    x[1], x[[0, 2]], x[:, 1] = 5.0, x[3].clone(), x[:, 0]
    x[torch.tensor([True, False, False, True])] *= 2
    return x[np.array([0, 1])] + x[torch.tensor([2, 3])] + x[x[:, 0] > -9][:2]


def learned(x: Tensor) -> Tensor:
    """Two steps of training with clipped gradients."""
    torch.manual_seed(3)
    model = nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4), nn.ReLU(), nn.Linear(4, 1)).to(x.device)
    optimizer = torch.optim.AdamW(model.parameters(), lr=0.1)
    for _ in range(2):
        optimizer.zero_grad()
        model(x).square().mean().backward()
        nn.utils.clip_grad_norm_(model.parameters(), 0.1)
        optimizer.step()
    return model(x).detach()


class Cube(torch.autograd.Function):
    """A derivative of its own."""

    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x**3

    @staticmethod
    def backward(ctx, gradient: Tensor) -> Tensor:
        return 3 * ctx.saved_tensors[0] ** 2 * gradient


ACCEPTED: dict[str, Callable[[Tensor], Tensor]] = {
    "scalars of the CPU": lambda x: x * torch.tensor(2.0) + torch.where(x > 0, x, torch.tensor(1.0)) + 3,
    "factories": lambda x: x @ torch.eye(3, device=x.device) + torch.arange(3, device=x.device) + x.new_tensor([1, 2, 3])
    + torch.tensor([1.0, 2, 3], device=x.device) + torch.full((3,), 2.0).to(x) + torch.zeros_like(x),
    "copies": lambda x: x.clone().copy_(X + 1) + X.to(x.device, torch.float64),
    "algebra": lambda x: torch.linalg.solve(SQUARE.to(x.device), x.mT) + torch.linalg.svdvals(x)[:, None],
    "views": lambda x: x.mT.reshape(-1)[::2].unsqueeze(0).expand(2, -1).contiguous().squeeze(),
    "attention": lambda x: nn.functional.scaled_dot_product_attention(x[None], x[None], x[None]),
    "random": lambda x: torch.rand(5, generator=torch.Generator(x.device).manual_seed(2), device=x.device),
    "autograd": lambda x: torch.autograd.grad(Cube.apply(y := x.clone().requires_grad_()).sum(), y)[0],
    "hand": lambda x: toy_hand().to(x.device).points(torch.full((2, 6), 0.3).to(x.device)),
    "branches": branches, "indices": indexed, "training": learned,
}
"""Correct code, by name."""


@pytest.mark.parametrize("case", ACCEPTED)
def test_correct_code_gets_the_numbers_of_the_cpu(device: str, case: str) -> None:
    result = ACCEPTED[case](X.to(device))
    assert result.device == torch.device(DEVICE)
    assert torch.equal(result.cpu(), ACCEPTED[case](X)), case
    assert result.tolist() == result.cpu().tolist()


def test_code_without_a_device_is_left_alone() -> None:
    assert type(X + torch.rand(4, 3, generator=torch.Generator().manual_seed(0))) is Tensor
    require_device(DEVICE)
