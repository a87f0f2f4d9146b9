"""The symmetric kernel that turns pairs of point features into distances, factorised and chunked.

The first layer of the kernel is linear in its two arguments, W [a; b] = U a + V b, so it is computed once per point
instead of once per pair; the remaining layers run over chunks of rows and are computed again in the backward pass.
Source: paper section III-C and appendix (kernel MLP, matrix block computation); the factorisation is ours.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

ROWS_PER_CHUNK = 8
"""Hand points whose pairs are computed together."""


class DistanceHead(nn.Module):
    """K(a, b) = softplus((N(a, b) + N(b, a)) / 2 + base) with a two-hidden-layer perceptron N."""

    def __init__(self, width: int, hidden: tuple[int, int], initial_distance: float) -> None:
        super().__init__()
        self.first = nn.Linear(2 * width, hidden[0])
        self.second = nn.Linear(hidden[0], hidden[1])
        self.last = nn.Linear(hidden[1], 1)
        self.initial_distance = initial_distance
        with torch.no_grad():
            self.last.bias.fill_(float(inverse_softplus(torch.tensor(initial_distance))))

    def forward(
        self,
        hand: Float[Tensor, "b n width"],
        obj: Float[Tensor, "b m width"],
        base: Float[Tensor, "b n m"] | None = None,
    ) -> Float[Tensor, "b n m"]:
        """Distances [m].

        Args:
            hand: Features of the hand's points, latent included.
            obj: Features of the object's points, latent included.
            base: Distances [m] to which the kernel adds, before the softplus; none in the paper's form.
        """
        left, right = self.first.weight.chunk(2, 1)
        both = torch.cat([left, right])
        hand_left, hand_right = (hand @ both.T).chunk(2, -1)
        obj_left, obj_right = (obj @ both.T + self.first.bias.repeat(2)).chunk(2, -1)
        rows = []
        for start in range(0, hand.shape[1], ROWS_PER_CHUNK):
            part = slice(start, start + ROWS_PER_CHUNK)
            inputs = hand_left[:, part], hand_right[:, part], obj_right, obj_left
            rows.append(
                checkpoint(self._rows, *inputs, use_reentrant=False) if torch.is_grad_enabled() else self._rows(*inputs)
            )
        logits = torch.cat(rows, 1)
        if base is not None:
            offset = inverse_softplus(torch.tensor(self.initial_distance)).to(base)
            logits = logits - offset + inverse_softplus(base)
        return functional.softplus(logits.float())

    def _rows(
        self,
        hand_left: Float[Tensor, "b r h"],
        hand_right: Float[Tensor, "b r h"],
        obj_right: Float[Tensor, "b m h"],
        obj_left: Float[Tensor, "b m h"],
    ) -> Float[Tensor, "b r m"]:
        """The kernel before its softplus, for some rows; the last layer is linear, so the two orders are averaged before it."""
        forwards = self._second(hand_left[:, :, None] + obj_right[:, None])
        backwards = self._second(obj_left[:, None] + hand_right[:, :, None])
        return self.last((forwards + backwards) * 0.5)[..., 0]

    def _second(self, x: Float[Tensor, "b r m h"]) -> Float[Tensor, "b r m k"]:
        return functional.relu(self.second(functional.relu(x, inplace=not torch.is_grad_enabled())))


def inverse_softplus(x: Tensor) -> Tensor:
    """The y with softplus(y) = x, for x > 0; distances below 0.1 mm count as 0.1 mm."""
    x = x.clamp(min=1e-4)
    return x + torch.log(-torch.expm1(-x))
