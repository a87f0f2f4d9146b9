"""The latent variable z of the CVAE: its encoders, its prior, and how it is drawn. Source: paper section III-C."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from dro_grasp.graphs import repeat
from dro_grasp.network.encoder import SLOPE, EdgeLayer, Graph, PointLayer, nearest_neighbours

MAX_LOG_VARIANCE = 8.0  # Log-variances of z are clamped to plus and minus this. Source: ours
LAYERS = 3  # Of points whose values a second input scales and shifts. Source: ours
CERTAIN = -4.0  # Log-variance of the posterior of an untrained motion code. Source: ours


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
        graph = Graph(nearest_neighbours(points, self.neighbours))
        x, kept = torch.cat([points, features], -1), []
        for layer in self.layers:
            x = layer(x, graph)
            kept.append(x)
        x = self.final(torch.cat(kept, -1))
        mean, log_variance = self.head(torch.cat([x.amax(1), x.mean(1)], -1)).chunk(2, -1)
        return mean, log_variance.clamp(-MAX_LOG_VARIANCE, MAX_LOG_VARIANCE)


class Condition(nn.Module):
    """Input of the flow to z: the object relative to the placed open hand, and the hand's features."""

    SCALE = 0.1  # Unit of length inside the network, about the size of a cloud [m]. Source: ours

    def __init__(self, features: int, width: int) -> None:
        super().__init__()
        self.points = nn.Sequential(
            nn.Linear(features + 3, width), nn.LeakyReLU(SLOPE), nn.Linear(width, width), nn.LeakyReLU(SLOPE),
            nn.Linear(width, width))
        self.join = nn.Sequential(
            nn.Linear(2 * width + 2 * features, width), nn.LeakyReLU(SLOPE), nn.Linear(width, width))

    def forward(
        self, hand_features: Float[Tensor, "b n c"], obj_features: Float[Tensor, "b m c"], hand: Float[Tensor, "b n 3"],
        obj: Float[Tensor, "b m 3"],
    ) -> Float[Tensor, "b width"]:
        """One vector from the encoders' features and both clouds [m], which share a frame."""
        x = self.points(torch.cat([obj_features, (obj - hand.mean(1, keepdim=True)) / self.SCALE], -1))
        return self.join(torch.cat([x.amax(1), x.mean(1), hand_features.amax(1), hand_features.mean(1)], -1))


class FlowPrior(nn.Module):
    """p(z | hand, object) of any shape: a flow that carries N(0, I) to the posteriors' z along straight lines.

    Differs from the paper, whose prior is N(0, I): the flow learns how z of true grasps is distributed for this hand and
    object, instead of forcing a distribution on z. Source: flow matching, Lipman et al. 2023, Liu et al. 2023.
    """

    STEPS = 10  # Midpoint steps of the integration from noise to z. Source: ours
    DRAWS = 8  # Pairs of time and noise for each z in a training step; they are cheap beside the encoders. Source: ours

    def __init__(self, latent: int, width: int) -> None:
        super().__init__()
        self.enter = nn.Linear(latent + 2, width)
        self.layers = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.SiLU(), nn.Linear(2 * width, width))
            for _ in range(3))
        self.leave = nn.Linear(width, latent)

    def velocity(
        self, z: Float[Tensor, "b latent"], time: Float[Tensor, "b 1"], condition: Float[Tensor, "b width"]
    ) -> Float[Tensor, "b latent"]:
        """Velocity of points on the path; time runs from 0 (noise) to 1 (z)."""
        angle = 0.5 * torch.pi * time
        x = self.enter(torch.cat([z, angle.sin(), angle.cos()], -1)) + condition
        for layer in self.layers:
            x = x + layer(x)
        return self.leave(x)

    def loss(
        self, z: Float[Tensor, "b latent"], condition: Float[Tensor, "b width"], generator: torch.Generator
    ) -> Float[Tensor, " b"]:
        """Squared error of the velocity, mean over dimensions; its gradient reaches the condition, not z."""
        goal = z.detach().repeat_interleave(self.DRAWS, 0)
        noise = torch.randn(goal.shape, generator=generator, device=goal.device)
        time = torch.rand(len(goal), 1, generator=generator, device=goal.device)
        on_the_way = torch.lerp(noise, goal, time)
        error = self.velocity(on_the_way, time, condition.repeat_interleave(self.DRAWS, 0)) - (goal - noise)
        return error.square().mean(-1).unflatten(0, (-1, self.DRAWS)).mean(-1)

    def forward(self, noise: Float[Tensor, "b latent"], condition: Float[Tensor, "b width"]) -> Float[Tensor, "b latent"]:
        """Turn standard normal noise into z, by the midpoint rule."""
        length = 1 / self.STEPS

        def step(z: Float[Tensor, "b latent"], number: Int[Tensor, "1"]) -> Float[Tensor, "b latent"]:
            time = (number.to(z.dtype) / self.STEPS).expand(len(z), 1)
            middle = z + 0.5 * length * self.velocity(z, time, condition)
            return z + length * self.velocity(middle, time + 0.5 * length, condition)

        if not condition.requires_grad:
            return repeat(step, noise, self.STEPS)
        z = noise
        for number in torch.arange(self.STEPS, device=z.device).split(1):  # a graph that is captured has no gradients
            z = step(z, number)
        return z


class HandMotion(nn.Module):
    """z as a code of how the open hand moves into the grasp: encoded from both poses, decoded into shifts of points.

    It knows the hand alone, so it learns from any joint values, without grasps; the prior learns which motion suits an
    object. Differs from the paper, where z enters the kernel alone, as one bias for all pairs: too little to tell one
    finger to open and another to close.
    """

    SCALE = 0.05  # Unit of length inside the network, about the size of a shift [m]. Source: ours

    def __init__(self, features: int, latent: int, width: int) -> None:
        super().__init__()
        self.seen = Modulated(features + 3, 3, width)
        self.code = nn.Sequential(
            nn.Linear(2 * width, width), nn.LeakyReLU(SLOPE), nn.Linear(width, width), nn.LeakyReLU(SLOPE),
            nn.Linear(width, 2 * latent))
        self.shift = Modulated(features + 3, latent, width)
        self.last = nn.Linear(width, 3)
        last = self.code[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():
            # At unit variance the noise would drown the code before it is of any use.
            last.bias[latent:] = CERTAIN

    def encode(
        self, features: Float[Tensor, "b n c"], hand: Float[Tensor, "b n 3"], grasp: Float[Tensor, "b n 3"]
    ) -> tuple[Float[Tensor, "b latent"], Float[Tensor, "b latent"]]:
        """Mean and log-variance of the posterior, from the encoder's features and both poses of the hand [m]."""
        x = self.seen(self._points(features, hand), (grasp - hand) / self.SCALE)
        mean, log_variance = self.code(torch.cat([x.amax(1), x.mean(1)], -1)).chunk(2, -1)
        return mean, log_variance.clamp(-MAX_LOG_VARIANCE, MAX_LOG_VARIANCE)

    def forward(
        self, features: Float[Tensor, "b n c"], hand: Float[Tensor, "b n 3"], z: Float[Tensor, "b k latent"]
    ) -> Float[Tensor, "b k n 3"]:
        """The hand's points after each of k motions [m]."""
        return hand[:, None] + self.SCALE * self.last(self.shift(self._points(features, hand)[:, None], z[:, :, None]))

    def _points(self, features: Float[Tensor, "b n c"], hand: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n d"]:
        return torch.cat([features, (hand - hand.mean(1, keepdim=True)) / self.SCALE], -1)


class Modulated(nn.Module):
    """Layers on points whose values a second input scales and shifts: which point moves how far is a product, not a sum.

    Source: feature-wise linear modulation, Perez et al. 2018.
    """

    def __init__(self, inputs: int, control: int, width: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(inputs if i == 0 else width, width) for i in range(LAYERS))
        self.controls = nn.ModuleList(nn.Linear(control, 2 * width) for _ in range(LAYERS))

    def forward(self, x: Float[Tensor, "*#b n c"], control: Float[Tensor, "*#b k d"]) -> Float[Tensor, "*b n width"]:
        """Values of the points; the control is one for all or one for each of them, and batch axes broadcast."""
        for layer, modulation in zip(self.layers, self.controls, strict=True):
            scale, shift = modulation(control).chunk(2, -1)
            # One pass over the values and one in place: at inference these are the network's largest tensors.
            x = functional.leaky_relu(torch.addcmul(shift, layer(x), 1 + scale), SLOPE, inplace=True)
        return x


def sample_posterior(
    mean: Float[Tensor, "b latent"], log_variance: Float[Tensor, "b latent"], generator: torch.Generator
) -> Float[Tensor, "b latent"]:
    """A draw of z that lets gradients through."""
    noise = torch.randn(mean.shape, generator=generator, device=mean.device)
    return mean + noise * (0.5 * log_variance).exp()
