"""Scores of grasps, predicted or synthesised: the log-odds that they hold.

Source: the paper's appendix ranks predictions by DexGraspNet's energy and reports the best; the release does not rank.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.energy.grasp_energy import EnergyConfig, GraspEnergy
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.kinds import Checked
from dro_grasp.ranking.features import grasp_features
from dro_grasp.ranking.score_network import shipped_score_network


@dataclass(frozen=True)
class ScoreConfig(Checked):
    """How grasps are scored."""

    energy: EnergyConfig = field(default_factory=lambda: EnergyConfig(penetration=30.0))
    """Weights of the energy terms, as in the network's training. Predictions penetrate more than synthesised grasps, which
    closing partly repairs."""
    batch_size: int = 64
    """Grasps scored at once."""


@torch.no_grad()
def score_grasps(energy: GraspEnergy, grasps: GraspBatch, config: ScoreConfig | None = None) -> Float[Tensor, " n"]:
    """Mean log-odds of success in trials; higher is better, comparable among grasps of one hand and one object.

    Args:
        energy: Energy of the hand on the object, under the weights of the configuration.
        grasps: Any grasps of the two.
        config: Batch size.
    """
    network, scores, device = shipped_score_network(), [torch.zeros(0)], energy.centre.device
    for part in grasps.in_parts((config or ScoreConfig()).batch_size):
        # Each finger touches with its candidate nearest to the surface.
        terms = energy(part.T_object_wrist.to(device), part.joints.to(device)).terms
        features = grasp_features(energy, part, terms)  # the network is small and stays on the CPU
        scores.append(network(*(values.cpu() for values in features)).mean(-1))
    return torch.cat(scores)
