"""Ranks of matches with encoders whose features are known."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from dro_grasp.network.encoder import StaticGraphEncoder
from dro_grasp.train.config import AugmentationConfig
from dro_grasp.train.correspondence import matching_rank, mean_rank
from dro_grasp.train.data.bundle.training_file import Bundle
from dro_grasp.train.samples import SampleSource
from tests.helpers.tiny_bundle import TINY


class Known(StaticGraphEncoder):
    """Features that do not look at the points: one of each point alone, or noise that no two clouds share."""

    def __init__(self, noise: bool) -> None:
        nn.Module.__init__(self)
        self.noise = noise

    def forward(self, points: Tensor) -> Tensor:
        b, n = points.shape[:2]
        return torch.randn(b, n, 64) if self.noise else torch.eye(n).expand(b, n, n)


def test_ranks_are_one_for_known_points_and_half_for_unknown_ones(bundle: Bundle) -> None:
    source, seed = SampleSource(bundle, TINY, AugmentationConfig()), torch.Generator().manual_seed(0)
    assert matching_rank(Known(False), source, seed, 4) == {"toy": 1.0}
    torch.manual_seed(0)
    rank = matching_rank(Known(True), source, seed, 16)["toy"]
    assert abs(rank - (TINY.n_hand + 1) / 2) < 3
    others = torch.arange(TINY.n_hand).roll(1)
    assert mean_rank(Known(False), source, ("toy", "toy"), others, seed, 4) == 2.0, "one point is more similar"
