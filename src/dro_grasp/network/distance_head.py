"""The symmetric kernel that turns pairs of point features into distances, factorised and chunked.

The first layer of the kernel is linear in its two arguments, W [a; b] = U a + V b, so it is computed once per point
instead of once per pair. The remaining layers run over chunks of pairs small enough for a processor's cache, and are
computed again in the backward pass, so that memory does not grow with the number of pairs.
Source: paper section III-C and appendix (kernel MLP, matrix block computation); the factorisation is ours.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

from dro_grasp.network.kernels import fused_kernels

threshold_backward = torch.ops.aten.threshold_backward
PAIRS_PER_CHUNK = {"cpu": 2048, "cuda": 1 << 19}
"""Pairs of points whose hidden layers exist at a time, by kind of device; others count as cuda. Source: ours, timed."""
NEAREST = 1e-4  # Smaller distances count as this one where the softplus is inverted [m]. Source: ours


class DistanceHead(nn.Module):
    """K(a, b) = softplus((N(a, b) + N(b, a)) / 2 + base) with a two-hidden-layer perceptron N."""

    def __init__(self, width: int, hidden: tuple[int, int], initial_distance: float) -> None:
        super().__init__()
        self.first = nn.Linear(2 * width, hidden[0])
        self.second = nn.Linear(hidden[0], hidden[1])
        self.last = nn.Linear(hidden[1], 1)
        self.initial_distance = initial_distance
        with torch.no_grad():
            self.last.bias.fill_(float(inverse_softplus(torch.tensor(initial_distance, device="cpu"))))

    def forward(
        self, hand: Float[Tensor, "b n width"], obj: Float[Tensor, "b m width"], base: Float[Tensor, "b n m"] | None = None,
        rounded: bool = False,
    ) -> Float[Tensor, "b n m"]:
        """Distances [m], from features of the points with z, and from distances that the kernel corrects, if any [m].

        `rounded` lets a GPU multiply in bfloat16; sums have 32 bits.
        """
        left, right = self.first.weight.chunk(2, 1)
        both = torch.cat([left, right])
        with torch.autocast("cuda", torch.bfloat16) if rounded and hand.device.type == "cuda" else nullcontext():
            first = hand @ both.T, obj @ both.T
        hand_sides, object_sides = _sides(first[0]), _sides(first[1] + self.first.bias.repeat(2)).flip(0)
        values = hand_sides, object_sides, self.second.weight, self.second.bias, self.last.weight[0]
        fused = fused_kernels(hand_sides)
        pairs: Tensor = fused.PairLayers.apply(*values, rounded) if fused else _PairLayers.apply(*values)  # type: ignore[assignment]
        logits = pairs + self.last.bias
        if base is not None:
            offset = float(inverse_softplus(torch.tensor(self.initial_distance, device="cpu")))
            logits = logits - offset + inverse_softplus(base)
        return functional.softplus(logits)


def _sides(x: Float[Tensor, "b n h2"]) -> Float[Tensor, "2 b n h"]:
    """First-layer values of points as left and as right argument; in single precision from here on."""
    return torch.stack(x.float().chunk(2, -1))


def _chunks(hand: Float[Tensor, "2 b n h"], obj: Float[Tensor, "2 b m h"]) -> Iterator[tuple[slice, slice]]:
    """Slices of samples and of hand points whose pairs are computed together."""
    (_, b, n, _), m = hand.shape, obj.shape[2]
    pairs = PAIRS_PER_CHUNK.get(hand.device.type, PAIRS_PER_CHUNK["cuda"])
    rows = min(n, max(1, pairs // m))
    samples = max(1, pairs // (n * m))
    for i in range(0, b, samples):
        for j in range(0, n, rows):
            yield slice(i, i + samples), slice(j, j + rows)


def _hidden(
    hand: Float[Tensor, "2 s r h"], obj: Float[Tensor, "2 s m h"], weight: Float[Tensor, "k h"], bias: Float[Tensor, " k"]
) -> tuple[Float[Tensor, "p h"], Float[Tensor, "p k"]]:
    """Both hidden layers of a chunk, one row per order and pair."""
    x = (hand[:, :, :, None] + obj[:, :, None]).relu_().flatten(0, 3)
    return x, torch.addmm(bias, x, weight.T).relu_()


class _PairLayers(torch.autograd.Function):
    """Mean over both orders of the hidden layers' output, for every pair of a hand point and an object point.

    Chunks of pairs are computed one after the other, and once more in the backward pass, which keeps none of them.
    """

    @staticmethod
    def forward(
        ctx: Any, hand: Float[Tensor, "2 b n h"], obj: Float[Tensor, "2 b m h"], weight: Float[Tensor, "k h"],
        bias: Float[Tensor, " k"], last: Float[Tensor, " k"],
    ) -> Float[Tensor, "b n m"]:
        ctx.save_for_backward(hand, obj, weight, bias, last)
        out = hand.new_empty(*hand.shape[1:3], obj.shape[2])
        for samples, rows in _chunks(hand, obj):
            _, y = _hidden(hand[:, samples, rows], obj[:, samples], weight, bias)
            target = out[samples, rows]
            torch.mean((y @ last).view(2, *target.shape), 0, out=target)
        return out

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *grad_outputs: Float[Tensor, "b n m"]
    ) -> tuple[Float[Tensor, "..."], ...]:
        (grad,) = grad_outputs
        hand, obj, weight, bias, last = ctx.saved_tensors
        grads = tuple(torch.zeros_like(t) for t in ctx.saved_tensors)
        grad_hand, grad_obj, grad_weight, grad_bias, grad_last = grads
        for samples, rows in _chunks(hand, obj):
            x, y = _hidden(hand[:, samples, rows], obj[:, samples], weight, bias)
            # Half of the gradient goes to each order; rows of x and y are (order, sample, hand point, object point).
            here = (grad[samples, rows] * 0.5).expand(2, -1, -1, -1).flatten()
            grad_last += y.T @ here
            grad_y = threshold_backward(torch.outer(here, last), y, 0)
            grad_bias += grad_y.sum(0)
            grad_weight.addmm_(grad_y.T, x)
            grad_x = threshold_backward(grad_y @ weight, x, 0).view(2, *grad[samples, rows].shape, -1)
            grad_hand[:, samples, rows] += grad_x.sum(3)
            grad_obj[:, samples] += grad_x.sum(2)
        return grads


def inverse_softplus(x: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """The y with softplus(y) = x, for distances x [m]; those below NEAREST count as NEAREST."""
    x = x.clamp(min=NEAREST)
    return x + torch.log(-torch.expm1(-x))
