"""Scores of grasps before their closing is simulated: the log-odds that they hold.

Source: the paper's appendix ranks predictions by DexGraspNet's energy and reports the best; the release does not rank.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dro_grasp.devices import at_once
from dro_grasp.errors import WeightsError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.kinds import Checked
from dro_grasp.network.checkpoints import SHIPPED_FOLDER, history_of, load_small, save_weights
from dro_grasp.optimize.grasp_energy import EnergyConfig, GraspEnergy
from dro_grasp.predict.score.features import GRASP_FEATURES, LINK_FEATURES, feature_names, grasp_features

SHIPPED = SHIPPED_FOLDER / "ranking" / "quality.safetensors"  # The network that ships
FEATURES_KEY = "features"  # What a weights file records of the network's inputs: the list that it was trained with


class ScoreNetwork(nn.Module):
    """A set of links: each is embedded alone, embeddings are pooled by nearness and joined with features of the whole grasp.

    The order and the number of links do not matter, so any hand fits. Source: Deep Sets, Zaheer et al. 2017.
    """

    def __init__(self, trials: int, width: int = 64) -> None:
        super().__init__()
        of_link, of_grasp = (sum(f.width for f in table.values()) for table in (LINK_FEATURES, GRASP_FEATURES))
        self.link = nn.Sequential(nn.Linear(of_link, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU())
        self.grasp = nn.Sequential(
            nn.Linear(2 * width + of_grasp, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, trials))

    def forward(
        self, links: Float[Tensor, "n l features"], nearness: Float[Tensor, "n l"], whole: Float[Tensor, "n features_of_grasp"]
    ) -> Float[Tensor, "n trials"]:
        """Log-odds of success in each kind of trial; arguments as in GraspFeatures."""
        each = self.link(links)
        pooled = torch.cat([(each * nearness[..., None]).sum(1), each.amax(1), whole], -1)
        return self.grasp(pooled)


def save_score_network(
    network: ScoreNetwork, path: Path, about: dict[str, Any] | None = None, history: Sequence[dict[str, Any]] = ()
) -> None:
    """Write weights as `save_weights` does, with the features they were trained with."""
    save_weights(network, path, {FEATURES_KEY: feature_names()} | (about or {}), history)


def load_score_network(path: Path) -> ScoreNetwork:
    """Read weights, which must state that they were trained with LINK_FEATURES and GRASP_FEATURES."""
    trained = next((entry.get(FEATURES_KEY) for entry in reversed(history_of(path))), None)
    if trained != feature_names():
        raise WeightsError(f"{path} states the features {trained}; this version computes {feature_names()}; train "
                           "the network again (`python -m lab.recipe.ranking --folder out`)")
    return load_small(
        path, lambda tensors: ScoreNetwork(len(tensors["grasp.4.bias"]), len(tensors["link.0.bias"])),
        "a ranking network; train it again (`python -m lab.recipe.ranking --folder out`)")


@cache
def shipped_score_network() -> ScoreNetwork:
    """The network that ships, loaded once per process."""
    return load_score_network(SHIPPED)


@cache
def score_network_on(device: torch.device, weights: Path | None = None) -> ScoreNetwork:
    """The same, or one with other weights, on a device."""
    network = shipped_score_network() if weights is None else load_score_network(weights)
    return network if device.type == "cpu" else copy.deepcopy(network).to(device)


@dataclass(frozen=True)
class ScoreConfig(Checked):
    """How grasps are scored."""

    energy: EnergyConfig = field(default_factory=lambda: EnergyConfig(penetration=30.0))
    """Weights of the energy terms, as in the network's training. Predictions penetrate more than synthesized grasps, which
    closing partly repairs."""
    batch_size: int | None = None
    """Grasps scored at once; None takes what suits the device."""
    weights: Path | None = None
    """Weights of the network; None takes those that ship."""


ON_CPU = 64  # Grasps scored at once on a CPU (ours, timed)
EACH = 1e6  # Memory of a grasp: the poses of all surface points in three postures [bytes] (ours, counted)


@torch.no_grad()
def score_grasps(energy: GraspEnergy, grasps: GraspBatch, config: ScoreConfig | None = None) -> Float[Tensor, " n"]:
    """Mean log-odds of success in trials; higher is better, comparable among grasps of one hand and one object.

    Args:
        energy: Energy of the hand on the object, under the weights of the configuration.
        grasps: Any grasps of the two.
        config: Batch size and weights.
    """
    config, device, scores = config or ScoreConfig(), energy.device, [torch.zeros(0)]
    network, size = score_network_on(device, config.weights), at_once(device, ON_CPU, EACH, config.batch_size)
    for start in range(0, len(grasps), size):
        part, own = grasps[start : start + size], energy.rows(slice(start, start + size))
        # Each finger touches with its candidate nearest to the surface.
        terms = own(part.T_object_wrist.to(device), part.joints.to(device)).terms
        scores.append(network(*grasp_features(own, part, terms)).mean(-1).cpu())
    return torch.cat(scores)
