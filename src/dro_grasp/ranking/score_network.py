"""A small network that judges grasps: from what each link does at the object to how likely the grasp holds."""

from __future__ import annotations

from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dro_grasp.models.small_networks import SHIPPED_FOLDER, load_small

SHIPPED = SHIPPED_FOLDER / "ranking" / "quality.safetensors"
"""The network that scores are made with."""
LINK_FEATURES, GRASP_FEATURES = 16, 8
"""Numbers that describe a link and a grasp."""


class QualityNetwork(nn.Module):
    """Links are judged one by one, summed up by how near they are, and joined with what describes the whole grasp.

    The order of links does not matter, nor their number, so any hand fits. Source: Deep Sets, Zaheer et al. 2017.
    """

    def __init__(self, trials: int, width: int = 64) -> None:
        """Make it.

        Args:
            trials: Kinds of trial whose outcome is predicted.
            width: Of the hidden layers.
        """
        super().__init__()
        self.link = nn.Sequential(nn.Linear(LINK_FEATURES, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU())
        self.grasp = nn.Sequential(
            nn.Linear(2 * width + GRASP_FEATURES, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(),
            nn.Linear(width, trials))

    def forward(
        self, links: Float[Tensor, "n l features"], nearness: Float[Tensor, "n l"], whole: Float[Tensor, "n features_of_grasp"]
    ) -> Float[Tensor, "n trials"]:
        """Log-odds of success in each kind of trial.

        Args:
            links: What each link does.
            nearness: From 0, far from the object, to 1, on its surface.
            whole: What describes the whole grasp.
        """
        each = self.link(links)
        pooled = torch.cat([(each * nearness[..., None]).sum(1), each.amax(1), whole], -1)
        return self.grasp(pooled)


@cache
def shipped_quality() -> QualityNetwork:
    """The network that ships, loaded once."""
    tensors = load_small(SHIPPED)
    network = QualityNetwork(len(tensors["grasp.4.bias"]), len(tensors["link.0.bias"]))
    network.load_state_dict(tensors)
    return network.eval().requires_grad_(False)
