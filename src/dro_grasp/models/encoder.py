"""Point cloud encoders: a static graph CNN for hand and object, and the graph layer it is made of.

Source: paper, appendix, point cloud encoder; layer widths as in the official release.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

SLOPE = 0.2
"""Negative slope of LeakyReLU. Source: appendix."""


def nearest_neighbours(points: Float[Tensor, "b n 3"], k: int) -> Int[Tensor, "b n k"]:
    """Indices of the k nearest points of each point, itself included."""
    return torch.cdist(points, points).topk(min(k, points.shape[1]), largest=False).indices


def gather(features: Float[Tensor, "b n c"], index: Int[Tensor, "b n k"]) -> Float[Tensor, "b n k c"]:
    """Features of each point's neighbours."""
    b, n, k = index.shape
    flat = index.reshape(b, n * k, 1).expand(-1, -1, features.shape[-1])
    return features.gather(1, flat).reshape(b, n, k, -1)


class EdgeLayer(nn.Module):
    """Graph convolution: max over neighbours of LeakyReLU(BatchNorm(W [x_j - x_i, x_i])).

    The linear map is applied per point before neighbours are gathered, which is the same because it is linear. In
    evaluation the normalisation is a positive or negative scale per channel, so the maximum is taken first.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(2 * inputs, outputs, bias=False)
        self.norm = nn.BatchNorm1d(outputs)

    def forward(self, x: Float[Tensor, "b n c"], index: Int[Tensor, "b n k"]) -> Float[Tensor, "b n d"]:
        """Features of the next layer."""
        difference, centre = self.linear.weight.chunk(2, 1)
        if not self.norm.training and self.norm.running_mean is not None and self.norm.running_var is not None:
            scale = self.norm.weight * torch.rsqrt(self.norm.running_var + self.norm.eps)
            neighbour = gather(x @ (difference * scale[:, None]).T, index).amax(2)
            own = x @ ((centre - difference) * scale[:, None]).T
            shift = self.norm.bias - self.norm.running_mean * scale
            return functional.leaky_relu(neighbour + own + shift, SLOPE)
        neighbour = gather(x @ difference.T, index)
        edge = neighbour + (x @ (centre - difference).T)[:, :, None]
        normed = self.norm(edge.flatten(0, 2)).reshape(edge.shape)
        return functional.leaky_relu(normed.amax(2), SLOPE)


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
        index = nearest_neighbours(points, self.neighbours)
        x, features = points, []
        for layer in self.layers:
            x = layer(x, index)
            features.append(x)
        overall = x.mean(1, keepdim=True).expand(-1, x.shape[1], -1)
        return self.final(torch.cat([*features, overall], -1))
