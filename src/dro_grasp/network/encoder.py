"""Point cloud encoders: a static graph CNN for hand and object, and the graph layer it is made of.

Source: paper, appendix, point cloud encoder; layer widths as in the official release.
"""

from __future__ import annotations

from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from dro_grasp.network.kernels import fused_kernels

SLOPE = 0.2  # Negative slope of LeakyReLU. Source: appendix


def nearest_neighbours(points: Float[Tensor, "b n 3"], k: int) -> Int[Tensor, "b n k"]:
    """Indices of the k nearest points of each point, itself included."""
    if (fused := fused_kernels(points)) and points.shape[1] <= fused.COMPARED:
        return fused.nearest(points, min(k, points.shape[1])).long()
    return torch.cdist(points, points).topk(min(k, points.shape[1]), largest=False).indices


class Graph:
    """The neighbours of each point, and what all layers on them share."""

    def __init__(self, index: Int[Tensor, "b n k"]) -> None:
        self.index = index

    @cached_property
    def adjacency(self) -> Float[Tensor, "b n n"]:
        """1 where the second point is a neighbour of the first, else 0."""
        b, n, _ = self.index.shape
        kind = torch.bfloat16 if torch.is_autocast_enabled("cuda") else torch.float32
        return torch.zeros(b, n, n, dtype=kind, device=self.index.device).scatter_(2, self.index, 1.0)

    @cached_property
    def degree(self) -> Float[Tensor, "b n 1"]:
        """Of how many points each is a neighbour."""
        return self.adjacency.sum(1, dtype=torch.float32)[..., None]

    @cached_property
    def narrow(self) -> Int[Tensor, "b n k"]:
        """The index as the fused kernel takes it."""
        return self.index.to(torch.int32).contiguous()


class EdgeLayer(nn.Module):
    """Graph convolution: max over neighbours of LeakyReLU(BatchNorm(W [x_j - x_i, x_i])).

    The linear map splits into a part of the neighbour and a part of the point itself, each computed once per point.
    Normalisation and LeakyReLU are monotone in each channel, so the neighbour that attains the maximum is found first,
    and only its value is carried on; the statistics of all edges follow from sums over points.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(2 * inputs, outputs, bias=False)
        self.norm = nn.BatchNorm1d(outputs)

    def forward(self, x: Float[Tensor, "b n c"], graph: Graph) -> Float[Tensor, "b n d"]:
        """Features of the next layer."""
        difference, centre = self.linear.weight.chunk(2, 1)
        # Single precision from here on: statistics are sums over very many edges.
        neighbour, own = (x @ torch.cat([difference, centre - difference]).T).float().chunk(2, -1)
        fused = fused_kernels(neighbour)
        if fused and self.norm.training:
            out, mean, variance = fused.EdgeMaximum.apply(
                neighbour, own, self.norm.weight, self.norm.bias, graph.narrow, graph.degree, graph.adjacency, self.norm.eps,
                SLOPE)
            self._track(mean, variance, graph)
            return out
        if self.norm.training:
            mean, variance = self._batch_statistics(neighbour, own, graph)
        else:
            mean, variance = self.norm.running_mean, self.norm.running_var
            assert mean is not None
            assert variance is not None
        scale, sign = self.norm.weight * torch.rsqrt(variance + self.norm.eps), torch.where(self.norm.weight < 0, -1.0, 1.0)
        if fused and not neighbour.requires_grad:
            highest = fused.highest_neighbours(neighbour, sign, graph.narrow)
        else:
            highest = self._highest(neighbour, sign.to(neighbour.dtype), graph.index)
        return functional.leaky_relu(torch.addcmul(self.norm.bias - mean * scale, highest + own, scale), SLOPE)

    def _highest(
        self, neighbour: Float[Tensor, "b n d"], sign: Float[Tensor, " d"], index: Int[Tensor, "b n k"]
    ) -> Float[Tensor, "b n d"]:
        """The value, among each point's neighbours, that a positive or negative scale makes the highest."""
        # Neighbours as rows of the clouds laid end to end.
        start = torch.arange(len(index), device=index.device)[:, None, None] * index.shape[1]
        rows, needs_source = (index + start).flatten(0, 1), neighbour.requires_grad
        with torch.no_grad():
            signed = (neighbour * sign).flatten(0, 1)
            best = signed.index_select(0, rows[:, 0])
            position = torch.zeros(best.shape, dtype=torch.int16, device=best.device)
            for j in range(1, rows.shape[1]):
                candidate = signed.index_select(0, rows[:, j])
                if needs_source:
                    position.masked_fill_(candidate > best, j)
                torch.maximum(best, candidate, out=best)
        if not needs_source:
            return (best * sign).view_as(neighbour)
        return neighbour.flatten(0, 1).gather(0, rows.gather(1, position.long())).view_as(neighbour)

    def _batch_statistics(
        self, neighbour: Float[Tensor, "b n d"], own: Float[Tensor, "b n d"], graph: Graph
    ) -> tuple[Float[Tensor, " d"], Float[Tensor, " d"]]:
        """Mean and variance over all edges, without forming them; running averages are updated as BatchNorm does."""
        k, edges, degree = graph.index.shape[-1], graph.index.numel(), graph.degree
        mean_neighbour = (degree * neighbour).sum((0, 1)) / edges
        mean_own = own.mean((0, 1))
        # Squares of centred values: differences of large sums would lose digits.
        left, right = neighbour - mean_neighbour, own - mean_own
        squares = degree * left.square() + k * right.square() + 2 * right * (graph.adjacency @ left)
        mean, variance = mean_neighbour + mean_own, squares.sum((0, 1)) / edges
        self._track(mean.detach(), variance.detach(), graph)
        return mean, variance

    @torch.no_grad()
    def _track(self, mean: Float[Tensor, " d"], variance: Float[Tensor, " d"], graph: Graph) -> None:
        norm, edges = self.norm, graph.index.numel()
        variance = variance * (edges / max(edges - 1, 1))
        if norm.running_mean is None or norm.running_var is None or norm.num_batches_tracked is None:
            return
        norm.num_batches_tracked += 1
        # Without a momentum BatchNorm keeps the plain mean of all batches.
        share = norm.momentum if norm.momentum is not None else 1.0 / float(norm.num_batches_tracked)
        norm.running_mean.lerp_(mean.to(norm.running_mean), share)
        norm.running_var.lerp_(variance.to(norm.running_var), share)


class PointLayer(nn.Module):
    """LeakyReLU(BatchNorm(W x)) on every point."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs, bias=False)
        self.norm = nn.BatchNorm1d(outputs)

    def forward(self, x: Float[Tensor, "b n c"]) -> Float[Tensor, "b n d"]:
        """Features of the next layer."""
        return functional.leaky_relu(self.norm(self.linear(x).flatten(0, 1)).reshape(*x.shape[:2], -1), SLOPE)


class StaticGraphEncoder(nn.Module):
    """Point-wise features of a cloud: edge layers on one fixed graph, a global mean, and a final layer."""

    def __init__(self, widths: tuple[int, ...], outputs: int, neighbours: int) -> None:
        super().__init__()
        self.neighbours = neighbours
        self.layers = nn.ModuleList(EdgeLayer(a, b) for a, b in zip((3, *widths[:-1]), widths, strict=True))
        self.final = PointLayer(sum(widths) + widths[-1], outputs)

    def forward(self, points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n outputs"]:
        """Encode clouds [m]; the caller decides on their frame."""
        graph = Graph(nearest_neighbours(points, self.neighbours))
        x, features = points, []
        for layer in self.layers:
            x = layer(x, graph)
            features.append(x)
        overall = x.mean(1, keepdim=True).expand(-1, x.shape[1], -1)
        return self.final(torch.cat([*features, overall], -1))
