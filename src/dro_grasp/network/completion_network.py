"""A small network that locates an object's surface: it merges distances to several guesses of the surface into one."""

from __future__ import annotations

from functools import cache

import torch
from jaxtyping import Float, Num
from torch import Tensor, nn

from dro_grasp.network.checkpoints import SHIPPED_FOLDER, load_small

SHIPPED = SHIPPED_FOLDER / "completion" / "surface.safetensors"  # The shipped network, which completes objects seen in part
LENGTH = 0.01  # Unit of the network's corrections [m]. Source: ours


class SurfaceNetwork(nn.Module):
    """Weighs guesses of a signed distance against each other, point by point, and corrects their mean.

    It judges every point by itself, so it learns how guesses fail, not the shapes of its training objects.
    """

    def __init__(self, guesses: int, features: int, width: int = 128, depth: int = 2) -> None:
        """Untrained, it returns nearly the first of the guesses, which is the best one."""
        super().__init__()
        self.guesses = guesses
        self.enter = nn.Linear(features, width)
        self.layers = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
            for _ in range(depth))
        self.leave = nn.Linear(width, guesses + 1)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)
        with torch.no_grad():
            self.leave.bias[0] = 1.0

    def forward(self, guessed: Float[Tensor, "*n guesses"], features: Float[Tensor, "*n features"]) -> Float[Tensor, "*n"]:
        """Signed distances to the surface [m], from those to the guesses [m] and other features of each point."""
        x = self.enter(features)
        for layer in self.layers:
            x = x + layer(x)
        weights, correction = self.leave(x).split([self.guesses, 1], -1)
        return (weights.softmax(-1) * guessed).sum(-1) + LENGTH * correction[..., 0]


@cache
def shipped_surface() -> SurfaceNetwork:
    """The network that ships, loaded once."""
    def sized(tensors: dict[str, Num[Tensor, "..."]]) -> SurfaceNetwork:
        width, features = tensors["enter.weight"].shape
        depth = sum(name.endswith(".0.weight") for name in tensors)
        return SurfaceNetwork(len(tensors["leave.bias"]) - 1, features, width, depth)

    return load_small(SHIPPED, sized, "the network that completes surfaces; install the package again")
