"""Fused kernels, in Triton's interpreter or on a GPU, and the layers that use them, against plain forms in double precision."""

from __future__ import annotations

import importlib.util
from types import ModuleType

import pytest
import torch
from torch import Tensor, nn

from dro_grasp.network import distance_head, encoder
from dro_grasp.network.distance_head import DistanceHead
from dro_grasp.network.encoder import EdgeLayer, Graph, nearest_neighbours
from tests.network.test_distance_head import naive_distances
from tests.network.test_network import plain_edge_layer


@pytest.fixture(params=["interpreter", pytest.param("cuda", marks=pytest.mark.gpu)])
def kernels(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, as_users_have_it: None) -> tuple[ModuleType, str]:
    """The module of kernels, and the device on which they run; layers on that device use them."""
    if importlib.util.find_spec("triton") is None:
        pytest.skip("no Triton, which is for Linux")
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    if request.param == "interpreter":
        if torch.cuda.is_available():
            pytest.skip("Triton compiles here")
    from dro_grasp.network import fused

    for module in (distance_head, encoder):
        monkeypatch.setattr(module, "fused_kernels", lambda values: fused if values.dtype == torch.float32 else None)
    return fused, "cpu" if request.param == "interpreter" else "cuda"


def compare(found: Tensor, exact: Tensor, inputs: list[Tensor], doubled: list[Tensor], tolerance: float) -> None:
    """Values and gradients of a random sum of them."""
    weight = torch.randn(exact.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(3)).to(exact.device)
    ours = [found, *torch.autograd.grad((found * weight.float()).sum(), inputs)]
    theirs = [exact, *torch.autograd.grad((exact * weight).sum(), doubled)]
    for a, b in zip(ours, theirs, strict=True):
        assert float((a - b).detach().abs().max()) <= tolerance * float(b.detach().abs().max())


@pytest.mark.parametrize("rounded", [False, True], ids=["exact", "bfloat16"])
@pytest.mark.parametrize("sizes", [(2, 20, 15, (10, 6)), (1, 9, 35, (70, 40)), (3, 8, 16, (64, 64))], ids=str)
def test_pairs_equal_the_chunked_form_in_double_precision(
    kernels: tuple[ModuleType, str], sizes: tuple[int, int, int, tuple[int, int]], rounded: bool
) -> None:
    torch.manual_seed(0)
    batch, n, m, hidden = sizes
    head = DistanceHead(12, hidden, 0.1).to(kernels[1])
    hand, obj = (torch.randn(batch, count, 12, device=kernels[1], requires_grad=True) for count in (n, m))
    twin = DistanceHead(12, hidden, 0.1).double().to(kernels[1])
    twin.load_state_dict(head.state_dict())
    doubled = [t.detach().double().requires_grad_() for t in (hand, obj)]
    exact = naive_distances(twin, *doubled)
    # Rounding moves single units across zero, whose gradient is there or not; the interpreter does not round.
    tolerance = 0.2 if rounded and kernels[1] == "cuda" else 2e-6
    found = head(hand, obj, rounded=rounded)
    compare(found, exact, [hand, obj, *head.parameters()], [*doubled, *twin.parameters()], tolerance)
    with torch.no_grad():
        assert torch.equal(head(hand, obj, rounded=rounded), found)


@pytest.mark.parametrize(("n", "k"), [(9, 9), (100, 7)])
def test_nearest_points_are_those_that_sorting_finds(kernels: tuple[ModuleType, str], n: int, k: int) -> None:
    points = torch.randn(2, n, 3, device=kernels[1], generator=torch.Generator(kernels[1]).manual_seed(0))
    exact = (points.double()[:, :, None] - points.double()[:, None]).norm(dim=-1).argsort(-1)[..., :k]
    assert torch.equal(encoder.nearest_neighbours(points, k), exact)


@pytest.mark.parametrize(("n", "width"), [(30, 12), (40, 70)])
def test_edge_layers_equal_their_plain_form_in_double_precision(kernels: tuple[ModuleType, str], n: int, width: int) -> None:
    device = kernels[1]
    torch.manual_seed(0)
    layer, norm = EdgeLayer(5, width).to(device), nn.BatchNorm1d(width).double().to(device)
    nn.init.normal_(layer.norm.weight)
    norm.load_state_dict(layer.norm.state_dict())
    twin = EdgeLayer(5, width).double().to(device)
    twin.load_state_dict(layer.state_dict())
    x = (torch.randn(2, n, 5, device=device) + 2).requires_grad_()
    index, doubled = nearest_neighbours(torch.randn(2, n, 3, device=device), 6), x.detach().double().requires_grad_()
    inputs = [x, layer.linear.weight, layer.norm.weight, layer.norm.bias]
    compare(layer(x, Graph(index)), plain_edge_layer(twin, norm, doubled, index), inputs,
            [doubled, twin.linear.weight, norm.weight, norm.bias], 2e-5)
    torch.testing.assert_close(layer.norm.running_var.double(), norm.running_var, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(layer.norm.running_mean.double(), norm.running_mean, rtol=1e-5, atol=1e-6)
    known = plain_edge_layer(twin, norm.eval(), doubled.detach(), index)
    with torch.no_grad():
        torch.testing.assert_close(layer.eval()(x, Graph(index)).double(), known, rtol=1e-4, atol=1e-5)

