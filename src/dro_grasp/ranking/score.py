"""Scores of grasps, however they were made: how likely they are to hold, or minus their energy.

Source: the paper's appendix ranks predictions by DexGraspNet's energy and reports the best; the release does not.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.energy.grasp_energy import EnergyConfig, GraspEnergy
from dro_grasp.energy.object_energy import evaluate_nearest
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.ranking.features import grasp_features
from dro_grasp.ranking.score_network import shipped_score_network


@dataclass(frozen=True)
class ScoreConfig:
    """How grasps are judged that the optimiser did not make."""

    by: Literal["quality", "energy"] = "quality"
    """`quality` is the mean log-odds of success in trials, of a network that has seen many; `energy` is minus the energy."""
    energy: EnergyConfig = field(default_factory=lambda: EnergyConfig(penetration=30.0))
    """Weights; predictions penetrate more than synthesised grasps, which closing partly repairs. The network was trained with
    these terms."""
    batch_size: int = 64
    """Grasps judged at once."""


@torch.no_grad()
def score_grasps(energy: GraspEnergy, grasps: GraspBatch, config: ScoreConfig | None = None) -> Float[Tensor, " n"]:
    """A score each: higher is better, comparable among grasps of one hand and one object.

    The contacts are taken to be each finger's candidate that is nearest to the surface.

    Args:
        energy: Of the grasps' hand on their object, with the weights of the configuration.
        grasps: Any grasps of the two.
        config: What the score is.
    """
    config, device = config or ScoreConfig(), energy.centre.device
    scores = [torch.zeros(0)]
    for start in range(0, len(grasps), config.batch_size):
        part = grasps[slice(start, start + config.batch_size)]
        terms = evaluate_nearest(energy, part.T_object_wrist.to(device), part.joints.to(device)).terms
        if config.by == "energy":
            scores.append(-terms.sum(-1).cpu())
        else:  # the network is small and stays on the CPU
            scores.append(shipped_score_network()(*(x.cpu() for x in grasp_features(energy, part, terms))).mean(-1))
    return torch.cat(scores)
