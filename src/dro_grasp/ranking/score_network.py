"""The network that ranks grasps: from what each link does at the object to the log-odds that the grasp holds."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dro_grasp.errors import WeightsError
from dro_grasp.models.checkpoints import SHIPPED_FOLDER, history_of, load_small, save_weights
from dro_grasp.ranking.features import GRASP_FEATURES, LINK_FEATURES, feature_names

SHIPPED = SHIPPED_FOLDER / "ranking" / "quality.safetensors"
"""The network that ships."""
FEATURES_KEY = "features"
"""What a weights file records about the network's inputs: the list of features that it was trained with."""


class ScoreNetwork(nn.Module):
    """A set of links: each is embedded alone, embeddings are pooled by nearness and joined with features of the whole grasp.

    The order and the number of links do not matter, so any hand fits. Source: Deep Sets, Zaheer et al. 2017.
    """

    def __init__(self, trials: int, width: int = 64) -> None:
        """Random weights.

        Args:
            trials: Kinds of trial whose outcome is predicted.
            width: Width of the hidden layers.
        """
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
    """Write weights in half precision, with the features they were trained with.

    Args:
        network: The network.
        path: The file.
        about: How the weights were made.
        history: The same of the weights that training began with, oldest first.

    Raises:
        OutputError: The file cannot be written.
    """
    save_weights(network, path, {FEATURES_KEY: feature_names()} | (about or {}), history)


def load_score_network(path: Path) -> ScoreNetwork:
    """Read weights.

    Raises:
        WeightsError: They were trained with other features than LINK_FEATURES and GRASP_FEATURES, or do not state them; or
            the file is missing, damaged, or of another network.
    """
    trained = next((entry.get(FEATURES_KEY) for entry in reversed(history_of(path))), None)
    if trained != feature_names():
        raise WeightsError(f"{path} states the features {trained}; this version computes {feature_names()}; train "
                           "the network again (scripts/train_ranking.py)")
    return load_small(
        path, lambda tensors: ScoreNetwork(len(tensors["grasp.4.bias"]), len(tensors["link.0.bias"])),
        "a ranking network; train it again (scripts/train_ranking.py)")


@cache
def shipped_score_network() -> ScoreNetwork:
    """The network that ships, loaded once per process."""
    return load_score_network(SHIPPED)
