"""A learned prior over placements: the poses of the open hand that the network is given.

Differs from the paper, which zero-centres the hand cloud and leaves the placement to the latent: here the open hand
starts near the grasp. The prior scores wrist rotations for an object and predicts the position of the grasp centre.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from dro_grasp.devices import at_once, side_by_side

MIN_SCALE = 0.003  # Smallest standard deviation of a mixture component [m]. Source: ours
LENGTH = 0.1  # Unit of length inside the network, about the size of an object [m]. Source: ours
SCALE = 0.03  # Unit of the components' standard deviations inside the network [m]. Source: ours
ROTATIONS_PER_PART = 16
"""Rotations whose hidden layers exist at a time on a CPU: those of more do not fit its cache. Source: ours, timed."""
COPIES = 3  # Copies of the largest hidden layer that a rotation needs. Source: ours, counted
COLDEST = 1e-3  # Lower temperatures choose components as this one does: the heaviest. Source: ours
PROPORTIONS = 72  # Numbers of a hand's proportions (`dro_grasp.hands.proportions`)
LEAST_SPREAD = 0.05  # Smallest spread of a proportion over hands: less tells hands apart by chance. Source: ours
FARTHEST = 3.0  # Largest distance of a proportion from the mean hand's, in spreads. Source: ours


class Standardised(nn.Module):
    """Proportions of hands relative to those of the hands in training."""

    mean: Float[Tensor, " f"]
    spread: Float[Tensor, " f"]

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(PROPORTIONS))
        self.register_buffer("spread", torch.ones(PROPORTIONS))

    def measure(self, hands: Float[Tensor, "hands f"]) -> None:
        """Take the mean and spread of these hands."""
        self.mean.copy_(hands.mean(0))
        self.spread.copy_(hands.std(0, unbiased=False).clamp_min(LEAST_SPREAD))

    def forward(self, hand: Float[Tensor, "*b f"]) -> Float[Tensor, "*b f"]:
        """In spreads from the mean."""
        return ((hand - self.mean) / self.spread).clamp(-FARTHEST, FARTHEST)


class PlacementPrior(nn.Module):
    """A point network over the object in the hand's axes, with the hand's proportions, to a mixture density and a score.

    Source: ours, as is what it knows of the hand: its proportions serve hands never seen better than learned features.
    """

    def __init__(self, width: int, components: int) -> None:
        super().__init__()
        self.components = components
        self.standardised = Standardised()
        self.points = nn.Sequential(nn.Linear(3, width // 2), nn.ReLU(), nn.Linear(width // 2, width), nn.ReLU(),
                                    nn.Linear(width, 2 * width))
        self.hand = nn.Linear(PROPORTIONS, width)
        self.head = nn.Sequential(nn.Linear(3 * width, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(),
                                  nn.Linear(width, components * 7 + 1))

    def forward(
        self, obj: Float[Tensor, "b m 3"], hand: Float[Tensor, "b f"]
    ) -> tuple[Float[Tensor, "b k"], Float[Tensor, "b k 3"], Float[Tensor, "b k 3"], Float[Tensor, " b"]]:
        """Mixture logits, means [m], standard deviations [m], and the score of the rotation.

        `obj` are object points in the hand's axes about the object's centre [m], `hand` proportions of the hand.
        """
        x = torch.cat([self.points(obj * (1 / LENGTH)).amax(1), self.hand(self.standardised(hand))], -1)
        out = self.head(x)
        logits, mean, scale = out[:, :-1].split([self.components, 3 * self.components, 3 * self.components], -1)
        mean = mean.unflatten(-1, (self.components, 3)) * LENGTH
        scale = functional.softplus(scale).unflatten(-1, (self.components, 3)) * SCALE + MIN_SCALE
        return logits, mean, scale, out[:, -1]

    def log_density(
        self, obj: Float[Tensor, "b m 3"], hand: Float[Tensor, "b f"], position: Float[Tensor, "b 3"]
    ) -> tuple[Float[Tensor, " b"], Float[Tensor, " b"]]:
        """Log density of a position of the grasp centre, and the score of the rotation."""
        logits, mean, scale, score = self(obj, hand)
        normal = -0.5 * ((position[:, None] - mean) / scale).square() - scale.log() - 0.5 * math.log(2 * math.pi)
        return torch.logsumexp(torch.log_softmax(logits, -1) + normal.sum(-1), -1), score

    def sample(
        self, obj: Float[Tensor, "m 3"], hand: Float[Tensor, " f"], rotations: Float[Tensor, "r 3 3"], num: int,
        generator: torch.Generator, temperature: float,
    ) -> tuple[Float[Tensor, "num 3 3"], Float[Tensor, "num 3"]]:
        """Choose rotations by their scores, none twice, and draw a position of the grasp centre for each.

        Args:
            obj: Object points about the object's centre, in the object's axes [m].
            rotations: Candidate rotations of the hand's axes in the object's.
            temperature: Scales the spread of the drawn positions.

        Returns:
            Rotations, and positions in the hand's axes about the object's centre [m].
        """
        each = 4.0 * COPIES * len(obj) * 2 * self.hand.out_features
        size = at_once(obj.device, ROTATIONS_PER_PART, each)
        parts = side_by_side(lambda some: self(obj @ some, hand.expand(len(some), -1)), rotations.split(size))
        logits, mean, scale, score = (torch.cat(values) for values in zip(*parts, strict=True))
        # The largest of (log-probability + Gumbel noise) is a draw from the distribution; the n largest, n without repetition.
        chosen = (score + gumbel(score.shape, generator).to(score)).topk(num).indices
        noise = gumbel(torch.Size([num, self.components]), generator).to(score)
        component = (logits[chosen] / max(temperature, COLDEST) + noise).argmax(-1)
        row = torch.arange(num, device=score.device)
        spread = torch.randn(num, 3, generator=generator, device=generator.device).to(score) * temperature
        return rotations[chosen], mean[chosen][row, component] + scale[chosen][row, component] * spread


def gumbel(shape: torch.Size, generator: torch.Generator) -> Float[Tensor, "..."]:
    """Standard Gumbel noise, on the generator's device."""
    uniform = torch.rand(shape, generator=generator, device=generator.device).clamp(1e-9, 1 - 1e-7)
    return -torch.log(-torch.log(uniform))
