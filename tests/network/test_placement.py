"""The placement prior's density against torch.distributions, and its samples against its density."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.distributions import Categorical, Independent, MixtureSameFamily, Normal

from dro_grasp.network.placement import PROPORTIONS, PlacementPrior

COMPONENTS = 3


@pytest.fixture
def prior() -> PlacementPrior:
    """Untrained, with outputs large enough to tell components and rotations apart."""
    torch.manual_seed(0)
    made = PlacementPrior(16, COMPONENTS)
    torch.nn.init.normal_(made.head[-1].weight, std=1.0)
    return made.requires_grad_(False)


@pytest.fixture
def obj() -> Tensor:
    return torch.randn(20, 3, generator=torch.Generator().manual_seed(1)) * torch.tensor([0.05, 0.02, 0.1])


HAND = torch.randn(PROPORTIONS, generator=torch.Generator().manual_seed(2))


def mixture(prior: PlacementPrior, obj: Tensor, hand: Tensor) -> MixtureSameFamily:
    logits, mean, scale, _ = prior(obj, hand)
    return MixtureSameFamily(Categorical(logits=logits), Independent(Normal(mean, scale), 1))


def rotations(count: int) -> Tensor:
    made = torch.linalg.qr(torch.randn(count, 3, 3, generator=torch.Generator().manual_seed(3)))[0]
    return made * torch.linalg.det(made)[:, None, None]


def test_log_density_equals_pytorchs(prior: PlacementPrior, obj: Tensor) -> None:
    objects, hands = obj @ rotations(5), HAND.expand(5, -1)
    position = torch.randn(5, 3) * 0.1
    density, score = prior.log_density(objects, hands, position)
    torch.testing.assert_close(density, mixture(prior, objects, hands).log_prob(position), rtol=1e-4, atol=1e-4)
    assert torch.equal(score, prior(objects, hands)[3])


def test_samples_repeat_with_the_generator(prior: PlacementPrior, obj: Tensor) -> None:
    def draw(seed: int) -> tuple[Tensor, Tensor]:
        return prior.sample(obj, HAND, rotations(32), 8, torch.Generator().manual_seed(seed), 0.7)

    for a, b in zip(draw(1), draw(1), strict=True):
        assert torch.equal(a, b)
    assert not torch.equal(draw(1)[1], draw(2)[1])


def test_positions_are_distributed_as_the_density(prior: PlacementPrior, obj: Tensor) -> None:
    count = 20_000
    one = rotations(1)
    drawn = prior.sample(obj, HAND, one.expand(count, -1, -1), count, torch.Generator().manual_seed(0), 1.0)[1]
    density = mixture(prior, obj @ one, HAND[None])
    expected = density.sample(torch.Size([count]))[:, 0]
    # Kolmogorov's statistic of two samples stays below 1.95 sqrt(2 / n) in 999 of 1000 cases.
    values = [(drawn[:, axis], expected[:, axis]) for axis in range(3)]
    values.append((density.log_prob(drawn[:, None])[:, 0], density.log_prob(expected[:, None])[:, 0]))
    for ours, theirs in values:
        grid = torch.cat([ours, theirs])
        ranks = [torch.searchsorted(x.sort().values, grid, right=True) / count for x in (ours, theirs)]
        assert float((ranks[0] - ranks[1]).abs().max()) < 1.95 * (2 / count) ** 0.5


def test_low_temperature_gives_the_heaviest_means(prior: PlacementPrior, obj: Tensor) -> None:
    turned, positions = prior.sample(obj, HAND, rotations(32), 8, torch.Generator().manual_seed(0), 0.0)
    logits, mean, _, _ = prior(obj @ turned, HAND.expand(8, -1))
    torch.testing.assert_close(positions, mean[torch.arange(8), logits.argmax(-1)])


def test_rotations_are_drawn_by_their_scores_without_repetition(prior: PlacementPrior, obj: Tensor) -> None:
    candidates, rounds = rotations(4), 3000
    prior.head[-1].weight[-1] *= 50
    score = prior(obj @ candidates, HAND.expand(4, -1))[3]
    generator, counts = torch.Generator().manual_seed(0), torch.zeros(4)
    for _ in range(rounds):
        chosen = prior.sample(obj, HAND, candidates, 1, generator, 1.0)[0]
        counts += (chosen == candidates).all(-1).all(-1)
    expected = torch.softmax(score, 0)
    assert float(expected.max() - expected.min()) > 0.2
    assert bool(((counts / rounds - expected).abs() < 4 * (expected * (1 - expected) / rounds).sqrt() + 1e-3).all())
    everything = prior.sample(obj, HAND, candidates, 4, generator, 1.0)[0]
    assert sorted(everything.flatten(1).tolist()) == sorted(candidates.flatten(1).tolist())
