"""A small network that locates an object's surface: it merges distances to several guesses of the surface into one."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float, Num
from torch import Tensor, nn

from dro_grasp.network.checkpoints import SHIPPED_FOLDER, load_small

SHIPPED = SHIPPED_FOLDER / "completion" / "surface.safetensors"  # The shipped network, which completes objects seen in part
LENGTH = 0.01  # Unit of the network's corrections [m]. Source: ours
UNIT = 0.05  # Length that the network receives as 1 [m] (ours)
SMALLEST = 0.005  # Least radius of a visible side in the image [m] (ours)


class SurfaceFeatures(NamedTuple):
    """Input of the network at n places of each view."""

    guessed: Float[Tensor, "*v n guesses"]
    """Signed distances to the guesses [m]."""
    features: Float[Tensor, "*v n features"]
    """Other features of each place."""
    places: Float[Tensor, "*v n 3"]
    """The places in view axes [m]."""
    seen: Float[Tensor, "*v m 6"]
    """Points of the visible side in view axes [m], and their normals."""
    upright: Float[Tensor, "*v"]
    """1 where the y axis is the image of the upward direction, 0 where that is not known."""


class SurfaceNetwork(nn.Module):
    """Weighs guesses of a signed distance against each other, place by place, and corrects their mean.

    What it does depends on the whole visible side: a code of all seen points scales and shifts every layer.
    Source: codes of points, Qi et al. 2017 (PointNet); scales and shifts, Perez et al. 2018 (FiLM); together ours.
    """

    def __init__(self, guesses: int, features: int, width: int = 128, depth: int = 3, code: int = 128) -> None:
        """Untrained, it returns nearly the first of the guesses, which is the best one."""
        super().__init__()
        self.guesses = guesses
        self.points = nn.Sequential(
            nn.Linear(9, code // 2), nn.SiLU(), nn.Linear(code // 2, code), nn.SiLU(), nn.Linear(code, code))
        self.films = nn.Sequential(nn.Linear(2 * code + 1, code), nn.SiLU(), nn.Linear(code, 2 * width * depth))
        self.enter = nn.Linear(features + 6, width)
        self.norm = nn.LayerNorm(width, elementwise_affine=False)
        self.layers = nn.ModuleList(
            nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width)) for _ in range(depth))
        self.leave = nn.Linear(width, guesses + 1)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)
        with torch.no_grad():
            self.leave.bias[0] = 1.0

    def forward(self, told: SurfaceFeatures) -> Float[Tensor, "*v n"]:
        """Signed distances to the surface at n places of each view [m]."""
        guessed, features, places, seen, upright = told
        # Both in units of a length, and of the visible side's own radius in the image.
        radius = seen[..., :2].norm(dim=-1).amax(-1)[..., None, None].clamp_min(SMALLEST)
        codes = self.points(torch.cat([seen[..., :3] / UNIT, seen[..., :3] / radius, seen[..., 3:]], -1))
        code = torch.cat([codes.amax(-2), codes.mean(-2), upright[..., None]], -1)
        films = self.films(code).unflatten(-1, (len(self.layers), 2, 1, -1))
        x = self.enter(torch.cat([features, places / UNIT, places / radius], -1))
        for k, layer in enumerate(self.layers):
            scale, shift = films[..., k, 0, :, :], films[..., k, 1, :, :]
            x = x + layer(self.norm(x) * (1 + scale) + shift)
        weights, correction = self.leave(x).split([self.guesses, 1], -1)
        return (weights.softmax(-1) * guessed).sum(-1) + LENGTH * correction[..., 0]


@cache
def load_surface(path: Path = SHIPPED) -> SurfaceNetwork:
    """The network of a file, by default the one that ships, loaded once."""
    def sized(tensors: dict[str, Num[Tensor, "..."]]) -> SurfaceNetwork:
        width, features = tensors["enter.weight"].shape
        depth = sum(name.startswith("layers.") and name.endswith(".0.weight") for name in tensors)
        return SurfaceNetwork(len(tensors["leave.bias"]) - 1, features - 6, width, depth, len(tensors["films.0.bias"]))

    return load_small(path, sized, "the network that completes surfaces; install the package again")
