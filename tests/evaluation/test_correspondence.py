"""Ranks of counterparts with encoders whose features are known, and counterparts of hands whose geometry is."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from dro_grasp.datasets.bundle.training_file import Bundle
from dro_grasp.evaluation.correspondence import counterparts, matching_rank, matching_rank_between, most_similar
from dro_grasp.models.encoder import StaticGraphEncoder
from dro_grasp.training.config import AugmentationConfig
from dro_grasp.training.samples import SampleSource
from tests.helpers.loaded_hands import loaded_hand
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
    assert matching_rank_between(Known(False), source, "toy", "toy", seed, 4) == 1.0


def test_counterparts_lie_on_the_same_part_of_the_hand() -> None:
    hand, other = loaded_hand("allegro"), loaded_hand("leaphand")
    assert torch.equal(counterparts(hand, hand), torch.arange(hand.n_points))
    index = counterparts(hand, other)
    on_palm, lands_on_palm = hand.link_index == hand.palm, other.link_index[index] == other.palm
    assert float(lands_on_palm[on_palm].float().mean()) > 0.6
    tips = torch.isin(hand.link_index, torch.tensor(hand.tips))
    assert float(lands_on_palm[tips].float().mean()) < 0.1


def test_the_most_similar_point_has_the_most_similar_feature() -> None:
    points = torch.randn(10, 3)
    assert torch.equal(most_similar(Known(False), points, points), torch.arange(10))
