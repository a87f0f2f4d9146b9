"""The score of a settled grasp: what the ranking network says of it, corrected by how it was seen to hold the object.

Ours. No force is tried on the object; the correction was trained on outcomes of trials.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dro_grasp.network.checkpoints import SHIPPED_FOLDER, load_small

if TYPE_CHECKING:
    from dro_grasp.simulation.grasp_state import GraspState

SHIPPED = SHIPPED_FOLDER / "ranking" / "holding.safetensors"  # The model that ships
FEATURES = 11  # Numbers of each grasp that the network sees; see `holding_features`
LEAST_MOTION = 1e-4  # Motions below this look alike [m, rad, m/s, rad/s] (ours)


class HoldingScore(nn.Module):
    """A small network on a dozen numbers of each grasp."""

    mean: Float[Tensor, " features"]  # of each number over the training grasps, as their `deviation`
    deviation: Float[Tensor, " features"]

    def __init__(self, trials: int, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(FEATURES, width), nn.SiLU(), nn.Linear(width, trials))
        self.register_buffer("mean", torch.zeros(FEATURES))
        self.register_buffer("deviation", torch.ones(FEATURES))

    def forward(self, features: Float[Tensor, "n features"]) -> Float[Tensor, "n trials"]:
        """Log-odds of success in each kind of trial; for the argument see `holding_features`."""
        return self.layers((features - self.mean) / self.deviation)


def holding_features(score: Float[Tensor, " n"], state: GraspState) -> Float[Tensor, "n features"]:
    """The network's inputs, from what the ranking network says of grasps [log-odds] and how they hold the object."""
    motion = torch.stack([state.shift, state.turn, state.speed, state.spin], 1).clamp_min(LEAST_MOTION).log()
    amounts = torch.stack([state.contacts, state.links, state.pressure], 1).log1p()
    return torch.cat([score[:, None], motion, amounts, state.slip[:, None].clamp_max(2), state.unanswered], 1)


@torch.no_grad()
def holding_score(score: Float[Tensor, " n"], state: GraspState) -> Float[Tensor, " n"]:
    """Mean log-odds of success in trials; higher is better, comparable among hands and objects. Arguments as above."""
    return shipped_holding_score()(holding_features(score, state)).mean(1)


def load_holding_score(path: Path) -> HoldingScore:
    """Read a model."""
    return load_small(
        path, lambda tensors: HoldingScore(len(tensors["layers.2.bias"]), len(tensors["layers.0.bias"])),
        "a score of settled grasps; train it again (scripts/train_holding_score.py)")


@cache
def shipped_holding_score() -> HoldingScore:
    """The model that ships, loaded once per process."""
    return load_holding_score(SHIPPED)
