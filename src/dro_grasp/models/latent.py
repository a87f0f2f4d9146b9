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


class ConditionalPrior(nn.Module):
    """p(z | hand, object): a Gaussian read off the features of both clouds; N(0, I) before training.

    Differs from the paper, whose prior is N(0, I) whatever hand and object are.
    """

    def __init__(self, features: int, latent: int, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(4 * features, width), nn.LeakyReLU(SLOPE), nn.Linear(width, width), nn.LeakyReLU(SLOPE))
        self.last = nn.Linear(width, 2 * latent)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(
        self, hand: Float[Tensor, "b n c"], obj: Float[Tensor, "b m c"]
    ) -> tuple[Float[Tensor, "b latent"], Float[Tensor, "b latent"]]:
        """Mean and log-variance of the prior."""
        mean, log_variance = self.last(self.layers(pooled(hand, obj))).chunk(2, -1)
        return mean, log_variance.clamp(-MAX_LOG_VARIANCE, MAX_LOG_VARIANCE)


class FlowPrior(nn.Module):
    """p(z | hand, object) of any shape: a flow that carries N(0, I) to the posteriors' z along straight lines.

    Differs from the paper, whose prior is N(0, I): what the true grasps' z look like, for this hand and object together,
    is learned beside them instead of being forced on them. Source: flow matching, Lipman et al. 2023, Liu et al. 2023.
    """

    STEPS = 10
    """Steps of the integration from noise to z."""
    DRAWS = 8
    """Times and noises that each z is trained with at once; they are cheap beside the encoders."""

    def __init__(self, features: int, latent: int, width: int) -> None:
        super().__init__()
        self.condition = nn.Sequential(nn.Linear(4 * features, width), nn.LeakyReLU(SLOPE), nn.Linear(width, width))
        self.enter = nn.Linear(latent + 2, width)
        self.layers = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.SiLU(), nn.Linear(2 * width, width))
            for _ in range(3))
        self.leave = nn.Linear(width, latent)

    def read(self, hand: Float[Tensor, "b n c"], obj: Float[Tensor, "b m c"]) -> Float[Tensor, "b width"]:
        """What the flow has to know of hand and object."""
        return self.condition(pooled(hand, obj))

    def velocity(
        self, z: Float[Tensor, "b latent"], time: Float[Tensor, "b 1"], condition: Float[Tensor, "b width"]
    ) -> Float[Tensor, "b latent"]:
        """Where a point of the path goes; time runs from 0, noise, to 1, z."""
        angle = 0.5 * torch.pi * time
        x = self.enter(torch.cat([z, angle.sin(), angle.cos()], -1)) + condition
        for layer in self.layers:
            x = x + layer(x)
        return self.leave(x)

    def loss(self, z: Float[Tensor, "b latent"], condition: Float[Tensor, "b width"]) -> Float[Tensor, " b"]:
        """Squared error of the velocity, mean over dimensions; its gradient reaches the condition, not z."""
        goal = z.detach().repeat_interleave(self.DRAWS, 0)
        noise, time = torch.randn_like(goal), torch.rand_like(goal[:, :1])
        on_the_way = torch.lerp(noise, goal, time)
        error = self.velocity(on_the_way, time, condition.repeat_interleave(self.DRAWS, 0)) - (goal - noise)
        return error.square().mean(-1).unflatten(0, (-1, self.DRAWS)).mean(-1)

    def forward(
        self, noise: Float[Tensor, "b latent"], condition: Float[Tensor, "b width"]
    ) -> Float[Tensor, "b latent"]:
        """z of standard normal noise, by the midpoint rule."""
        z, step = noise, 1 / self.STEPS
        for i in range(self.STEPS):
            time = torch.full_like(noise[:, :1], i * step)
            middle = z + 0.5 * step * self.velocity(z, time, condition)
            z = z + step * self.velocity(middle, time + 0.5 * step, condition)
        return z


class PointLatent(nn.Module):
    """z changes the features of every hand point, each in its own way; nothing before training.

    Differs from the paper, where z reaches the kernel alone, as one bias for all pairs: too little to tell one finger to
    open and another to close.
    """

    def __init__(self, features: int, latent: int) -> None:
        super().__init__()
        self.first = nn.Linear(features + latent, features)
        self.last = nn.Linear(features, features)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, features: Float[Tensor, "b n c"], z: Float[Tensor, "b latent"]) -> Float[Tensor, "b n c"]:
        """Features of the hand's points that know z."""
        joined = torch.cat([features, z[:, None].expand(-1, features.shape[1], -1)], -1)
        return features + self.last(nn.functional.leaky_relu(self.first(joined), SLOPE))


def pooled(hand: Float[Tensor, "b n c"], obj: Float[Tensor, "b m c"]) -> Float[Tensor, "b 4*c"]:
    """Largest and mean features of both clouds."""
    return torch.cat([hand.amax(1), hand.mean(1), obj.amax(1), obj.mean(1)], -1)


def sample_posterior(
    mean: Float[Tensor, "b latent"], log_variance: Float[Tensor, "b latent"]
) -> Float[Tensor, "b latent"]:
    """A draw of z that lets gradients through."""
    return mean + torch.randn_like(mean) * (0.5 * log_variance).exp()
