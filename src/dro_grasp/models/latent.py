"""The latent variable of the CVAE: its encoder, sampling, and divergence from the prior. Source: paper section III-C."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dro_grasp.models.encoder import SLOPE, EdgeLayer, PointLayer, nearest_neighbours

MAX_LOG_VARIANCE = 8.0
"""Log-variances are kept within plus and minus this."""


class LatentEncoder(nn.Module):
    """Hand and object in the grasp pose, with their features, to mean and log-variance of z."""

    def __init__(self, features: int, latent: int, widths: tuple[int, ...], head: tuple[int, int], neighbours: int) -> None:
        super().__init__()
        self.neighbours = neighbours
        inputs = (3 + features, *widths[:-1])
        self.layers = nn.ModuleList(EdgeLayer(a, b) for a, b in zip(inputs, widths, strict=True))
        self.final = PointLayer(sum(widths), head[0])
        self.head = nn.Sequential(nn.Linear(2 * head[0], head[0]), nn.LeakyReLU(SLOPE), nn.Linear(head[0], head[1]),
                                  nn.LeakyReLU(SLOPE), nn.Linear(head[1], 2 * latent))

    def forward(
        self, points: Float[Tensor, "b n 3"], features: Float[Tensor, "b n c"]
    ) -> tuple[Float[Tensor, "b latent"], Float[Tensor, "b latent"]]:
        """Mean and log-variance of the posterior."""
        index = nearest_neighbours(points, self.neighbours)
        x, kept = torch.cat([points, features], -1), []
        for layer in self.layers:
            x = layer(x, index)
            kept.append(x)
        x = self.final(torch.cat(kept, -1))
        mean, log_variance = self.head(torch.cat([x.amax(1), x.mean(1)], -1)).chunk(2, -1)
        return mean, log_variance.clamp(-MAX_LOG_VARIANCE, MAX_LOG_VARIANCE)


def sample_posterior(
    mean: Float[Tensor, "b latent"], log_variance: Float[Tensor, "b latent"]
) -> Float[Tensor, "b latent"]:
    """A draw of z that lets gradients through."""
    return mean + torch.randn_like(mean) * (0.5 * log_variance).exp()
