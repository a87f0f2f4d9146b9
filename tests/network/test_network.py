"""The network: graph layers against their plain form, symmetries, sizes, and what the latent does."""

from __future__ import annotations

import dataclasses
import math
import threading
from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from dro_grasp import devices
from dro_grasp.devices import fast_products
from dro_grasp.network.encoder import SLOPE, EdgeLayer, Graph, StaticGraphEncoder, nearest_neighbours
from dro_grasp.network.latent import FlowPrior
from dro_grasp.network.network import Attention, DistanceNetwork, untrained_network
from dro_grasp.network.presets import NetworkConfig

SMALL = NetworkConfig(
    n_hand=40, n_object=32, width=24, encoder_widths=(8, 16), neighbours=6, attention_hidden=32, latent=8,
    latent_widths=(8, 16), latent_head=(16, 16), latent_neighbours=5, kernel_hidden=(20, 12), placement_width=16,
)


def plain_edge_layer(layer: EdgeLayer, norm: nn.BatchNorm1d, x: Tensor, index: Tensor) -> Tensor:
    """Every edge's features, normalised by PyTorch, activated, then the maximum."""
    rows = torch.arange(len(x))[:, None, None]
    neighbour, own = x[rows, index], x[:, :, None].expand(-1, -1, index.shape[2], -1)
    edges = torch.cat([neighbour - own, own], -1) @ layer.linear.weight.T
    return functional.leaky_relu(norm(edges.flatten(0, 2)).view(edges.shape), SLOPE).amax(2)


@pytest.fixture
def edge_case() -> tuple[EdgeLayer, nn.BatchNorm1d, Tensor, Tensor]:
    torch.manual_seed(0)
    layer, norm = EdgeLayer(5, 12), nn.BatchNorm1d(12)
    nn.init.normal_(layer.norm.weight)
    nn.init.normal_(layer.norm.bias)
    norm.load_state_dict(layer.norm.state_dict())
    points = torch.randn(3, 30, 3)
    return layer, norm, torch.randn(3, 30, 5) + 2, nearest_neighbours(points, 7)


def test_edge_layer_equals_its_plain_form_in_training(
    edge_case: tuple[EdgeLayer, nn.BatchNorm1d, Tensor, Tensor]
) -> None:
    layer, norm, x, index = edge_case
    x.requires_grad_()
    weight = torch.randn(3, 30, 12)
    fast, slow = layer(x, Graph(index)), plain_edge_layer(layer, norm, x, index)
    torch.testing.assert_close(fast, slow, rtol=1e-4, atol=1e-5)
    ours = torch.autograd.grad((fast * weight).sum(), [x, layer.linear.weight, layer.norm.weight, layer.norm.bias])
    theirs = torch.autograd.grad((slow * weight).sum(), [x, layer.linear.weight, norm.weight, norm.bias])
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("momentum", [0.1, None], ids=["moving average", "plain mean"])
def test_edge_layer_keeps_the_statistics_of_batch_norm(
    edge_case: tuple[EdgeLayer, nn.BatchNorm1d, Tensor, Tensor], momentum: float | None
) -> None:
    layer, norm, x, index = edge_case
    layer.norm.momentum = norm.momentum = momentum
    for step in range(3):
        layer(x * (step + 1), Graph(index))
        plain_edge_layer(layer, norm, x * (step + 1), index)
    torch.testing.assert_close(layer.norm.running_mean, norm.running_mean, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(layer.norm.running_var, norm.running_var, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(
        layer.eval()(x, Graph(index)), plain_edge_layer(layer, norm.eval(), x, index), rtol=1e-4, atol=1e-5
    )


def test_statistics_do_not_lose_digits_far_from_zero() -> None:
    torch.manual_seed(0)
    layer, norm = EdgeLayer(3, 4), nn.BatchNorm1d(4)
    x, index = torch.randn(2, 20, 3) * 1e-2 + 10, nearest_neighbours(torch.randn(2, 20, 3), 4)
    double = EdgeLayer(3, 4).double()
    double.load_state_dict(layer.state_dict())
    exact = plain_edge_layer(double, norm.double(), x.double(), index)
    torch.testing.assert_close(layer(x, Graph(index)), exact.float(), rtol=1e-3, atol=2e-3)


def test_nearest_neighbours_are_the_nearest() -> None:
    torch.manual_seed(0)
    points = torch.rand(2, 50, 3)
    found = nearest_neighbours(points, 6)
    brute = (points[:, :, None] - points[:, None]).norm(dim=-1).argsort(-1)[..., :6]
    assert torch.equal(found.sort(-1).values, brute.sort(-1).values)


def test_encoder_does_not_care_for_the_order_of_points() -> None:
    torch.manual_seed(0)
    encoder = StaticGraphEncoder((8, 16), 24, 6).eval()
    points, order = torch.randn(2, 40, 3), torch.randperm(40)
    torch.testing.assert_close(encoder(points)[:, order], encoder(points[:, order]), rtol=1e-4, atol=1e-5)


def test_attention_equals_pytorch() -> None:
    torch.manual_seed(0)
    ours, theirs = Attention(16, 4), nn.MultiheadAttention(16, 4, batch_first=True)
    with torch.no_grad():
        theirs.in_proj_weight.copy_(torch.cat([ours.query.weight, ours.memory.weight]))
        theirs.in_proj_bias.copy_(torch.cat([ours.query.bias, ours.memory.bias]))
        theirs.out_proj.load_state_dict(ours.output.state_dict())
    x, memory = torch.randn(2, 9, 16), torch.randn(2, 7, 16)
    torch.testing.assert_close(ours(x, memory), theirs(x, memory, memory)[0], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("frame", ["object", "palm"])
def test_training_pass_has_gradients_everywhere(frame: str) -> None:
    torch.manual_seed(0)
    network = DistanceNetwork(dataclasses.replace(SMALL, frame=frame))
    hand, obj, grasp = torch.randn(4, 40, 3) * 0.1, torch.randn(4, 32, 3) * 0.1, torch.randn(4, 40, 3) * 0.1
    out = network(hand, obj, grasp, torch.Generator(), columns=10)
    assert out.distances.shape == (4, 40, 10)
    (out.distances.sum() + out.mean.sum() + out.log_variance.sum() + out.flow_error.sum()).backward()
    silent = [n for n, p in network.named_parameters() if p.grad is None and not n.startswith("placement")]
    assert not silent


def test_zero_centred_hand_forgets_its_place_unless_placed() -> None:
    torch.manual_seed(0)
    hand, obj, z = torch.randn(1, 40, 3) * 0.1, torch.randn(1, 32, 3) * 0.1, torch.randn(1, 8)
    moved = hand + torch.tensor([0.2, 0.0, 0.0])
    paper = DistanceNetwork(SMALL).eval()
    torch.testing.assert_close(paper.predict(hand, obj, z), paper.predict(moved, obj, z), rtol=1e-4, atol=1e-5)
    placed = DistanceNetwork(dataclasses.replace(SMALL, frame="palm")).eval()
    assert (placed.predict(hand, obj, z) - placed.predict(moved, obj, z)).abs().max() > 1e-3


def test_latents_change_the_prediction_and_temperature_scales_them() -> None:
    torch.manual_seed(0)
    network = DistanceNetwork(SMALL).eval()
    hand, obj = torch.randn(1, 40, 3) * 0.1, torch.randn(1, 32, 3) * 0.1
    z = network.sample_latent(2, torch.Generator().manual_seed(1))
    a, b = network.predict(hand.expand(2, -1, -1), obj.expand(2, -1, -1), z)
    assert (a - b).abs().max() > 1e-4
    torch.testing.assert_close(network.sample_latent(2, torch.Generator().manual_seed(1), 0.5), z * 0.5)


def test_a_flow_learns_a_distribution_of_two_modes_that_depends_on_the_condition() -> None:
    torch.manual_seed(0)
    flow, width = FlowPrior(latent=2, width=32), 32
    optimiser = torch.optim.Adam(flow.parameters(), lr=3e-3)
    generator = torch.Generator().manual_seed(0)
    apart = torch.tensor([[1.5, 0.0], [0.0, 1.5]])  # of the modes from their middle, for each of two conditions

    def condition(kind: Tensor) -> Tensor:
        return 3 * torch.nn.functional.one_hot(kind, width).float()

    for _ in range(400):
        kind = torch.randint(2, (128,))
        side = torch.randint(2, (128, 1)) * 2.0 - 1
        z = side * apart[kind] + 0.2 * torch.randn(128, 2)
        optimiser.zero_grad()
        flow.loss(z, condition(kind), generator).mean().backward()
        optimiser.step()
    for kind in range(2):
        with torch.no_grad():
            found = flow(torch.randn(2000, 2), condition(torch.full((2000,), kind)))
        along, across = (found @ a / a.norm() for a in (apart[kind], apart[1 - kind]))
        assert abs(float((along > 0).float().mean()) - 0.5) < 0.1
        assert float(along.abs().mean()) == pytest.approx(1.5, abs=0.15)
        assert float(along.abs().std()) < 0.4
        assert float(across.std()) < 0.4


@pytest.mark.parametrize(("velocity", "end"), [(lambda z, time: z, math.e), (lambda z, time: 3 * time**2 + 0 * z, 2.0)])
def test_a_flow_follows_its_velocity_to_second_order(velocity: Callable[[Tensor, Tensor], Tensor], end: float) -> None:
    """A tenth of a step errs by 1.7e-3 at most here; Euler's rule, and any other weights, by far more."""
    flow = FlowPrior(latent=1, width=4)
    flow.velocity = lambda z, time, condition: velocity(z, time)
    assert float(flow(torch.ones(1, 1), torch.zeros(1, 4))) == pytest.approx(end, rel=2.5e-3)


def test_a_latent_that_moves_the_hand_moves_its_points_apart() -> None:
    torch.manual_seed(0)
    network = DistanceNetwork(dataclasses.replace(SMALL, frame="palm")).eval()
    hand, obj, grasp = torch.randn(3, 40, 3) * 0.1, torch.randn(3, 32, 3) * 0.1, torch.randn(3, 40, 3) * 0.1
    features = network.hand_encoder(hand - hand.mean(1, keepdim=True))
    z = torch.randn(2, 3, 8)
    moved = network.motion(features, hand, z.transpose(0, 1))
    assert (moved[:, 0] - moved[:, 1]).norm(dim=-1).std(-1).min() > 1e-3
    mean, _ = network.motion.encode(features, hand, grasp)
    other, _ = network.motion.encode(features, hand, hand)
    assert (mean - other).norm(dim=-1).min() > 1e-2  # the code sees where the hand goes
    turned, _ = network.motion.encode(features[:, torch.arange(39, -1, -1)], hand.flip(1), grasp.flip(1))
    torch.testing.assert_close(turned, mean, rtol=1e-4, atol=1e-5)  # and not the order of its points
    assert network(hand, obj, grasp, torch.Generator()).flow_error.min() > 0


@pytest.mark.parametrize("changes", [{}, {"frame": "palm"}], ids=["paper", "ours"])
def test_a_z_predicts_in_training_what_it_does_at_inference(changes: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    hand, obj, grasp = torch.randn(3, 2, 40, 3, generator=torch.Generator().manual_seed(0)) * 0.1
    network = untrained_network(dataclasses.replace(SMALL, **changes), seed=3).eval()
    noise = torch.randn(2, SMALL.latent, generator=torch.Generator().manual_seed(1))
    moves = network.move(hand, obj, noise[:, None])
    monkeypatch.setattr("dro_grasp.network.latent.sample_posterior", lambda *_: moves.z[:, 0])
    found = network(hand, obj, grasp, torch.Generator(), columns=20).distances
    torch.testing.assert_close(found, network.predict(hand, obj, noise)[:, :, :20], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("changes", [{}, {"frame": "palm"}], ids=["paper", "ours"])
def test_all_randomness_comes_from_the_generator(changes: dict) -> None:
    hand, obj, grasp = torch.randn(3, 2, 40, 3, generator=torch.Generator().manual_seed(0)) * 0.1
    network = untrained_network(dataclasses.replace(SMALL, **changes), seed=3).eval()
    state = torch.get_rng_state()
    again = untrained_network(network.config, seed=3).eval()
    first = network(hand, obj, grasp, torch.Generator().manual_seed(1))
    assert torch.equal(torch.get_rng_state(), state), "the global generator is left alone"
    torch.manual_seed(99)
    second = again(hand, obj, grasp, torch.Generator().manual_seed(1))
    for name, value in vars(first).items():
        assert torch.equal(value, getattr(second, name)), name
    other = network(hand, obj, grasp, torch.Generator().manual_seed(2))
    assert not torch.equal(first.distances, other.distances)


@pytest.mark.parametrize("changes", [{}, {"frame": "palm"}], ids=["paper", "ours"])
def test_a_draw_that_is_picked_predicts_what_it_does_alone(changes: dict) -> None:
    torch.manual_seed(0)
    network = untrained_network(dataclasses.replace(SMALL, **changes), seed=3).eval()
    hand, obj, z = torch.randn(2, 40, 3) * 0.1, torch.randn(2, 32, 3) * 0.1, torch.randn(2, 4, 8)
    moves = network.move(hand, obj, z)
    assert network.z_moves == bool(changes)
    assert bool((moves.points.diff(dim=1) != 0).any()) == network.z_moves
    rows, draws = torch.tensor([1, 0, 1]), torch.tensor([2, 3, 0])
    alone = network.predict(hand[rows], obj[rows], z[rows, draws])
    torch.testing.assert_close(network.distances(moves.pick(rows, draws)), alone, rtol=1e-4, atol=1e-6)
    assert (alone[0] - alone[2]).abs().max() > 1e-4


def test_prediction_does_not_depend_on_the_batch() -> None:
    torch.manual_seed(0)
    network = DistanceNetwork(SMALL).eval()
    hand, obj, z = torch.randn(5, 40, 3) * 0.1, torch.randn(5, 32, 3) * 0.1, torch.randn(5, 8)
    whole = network.predict(hand, obj, z)
    for i in range(5):
        torch.testing.assert_close(network.predict(hand[i : i + 1], obj[i : i + 1], z[i : i + 1])[0], whole[i],
                                   rtol=1e-4, atol=1e-6)


def test_the_palm_s_frame_turns_with_the_hand() -> None:
    network = DistanceNetwork(dataclasses.replace(SMALL, frame="palm"))
    rotation = torch.linalg.qr(torch.randn(1, 3, 3, generator=torch.Generator().manual_seed(0)))[0]
    rotation = rotation * torch.linalg.det(rotation)
    points, centre = torch.rand(1, 6, 3), torch.rand(1, 3)
    expected = torch.einsum("ji,nj->ni", rotation[0], points[0] - centre)
    torch.testing.assert_close(network.to_frame(points, centre, rotation)[0], expected)
    assert torch.equal(DistanceNetwork(SMALL).to_frame(points, centre, rotation), points - centre)


def test_caller_keeps_the_precision_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "quick_path_is_accurate", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    before = torch.get_float32_matmul_precision()
    inside = []

    def fail() -> None:
        inside.append(torch.get_float32_matmul_precision())
        raise KeyError

    with pytest.raises(KeyError), fast_products():
        fail()
    assert inside == ["medium"]
    assert torch.get_float32_matmul_precision() == before


def test_the_setting_holds_until_the_last_thread_has_left_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "quick_path_is_accurate", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    before, entered, left, inside = torch.get_float32_matmul_precision(), threading.Event(), threading.Event(), []

    def early() -> None:
        with fast_products():
            entered.wait(10)
        left.set()

    thread = threading.Thread(target=early)
    thread.start()
    with fast_products():
        entered.set()
        left.wait(10)
        inside.append(torch.get_float32_matmul_precision())
    thread.join()
    assert inside == ["medium"]
    assert torch.get_float32_matmul_precision() == before


def test_inaccurate_processors_keep_full_precision(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "quick_path_is_accurate", lambda: False)
    before = torch.get_float32_matmul_precision()
    with fast_products():
        assert torch.get_float32_matmul_precision() == before


@pytest.mark.parametrize("frame", ["object", "palm"])
def test_mixed_precision_stays_near_single_precision(frame: str) -> None:
    torch.manual_seed(0)
    network = DistanceNetwork(dataclasses.replace(SMALL, frame=frame)).train()
    hand, obj, grasp = torch.randn(4, 40, 3) * 0.05, torch.randn(4, 32, 3) * 0.05, torch.randn(4, 40, 3) * 0.05
    found = {}
    for mixed in (False, True):
        network.mixed = mixed
        network.zero_grad()
        distances = network(hand, obj, grasp, torch.Generator().manual_seed(1)).distances
        assert distances.dtype == torch.float32
        (distances - torch.cdist(grasp, obj)).abs().mean().backward()
        weights = [p for n, p in network.named_parameters() if n.startswith("object_transformer") and p.grad is not None]
        found[mixed] = distances.detach(), torch.cat([p.grad.flatten() for p in weights])
    apart = (found[True][0] - found[False][0]).abs()
    assert 0 < apart.max() < 2e-3  # [m]
    assert torch.nn.functional.cosine_similarity(found[True][1], found[False][1], dim=0) > 0.95
