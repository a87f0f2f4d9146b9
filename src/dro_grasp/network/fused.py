"""Fused kernels of the network for CUDA, in Triton: what `distance_head` and `encoder` compute elsewhere in several passes.

Imported only where there is a CUDA device and Triton. Both kernels keep in registers what the plain form writes to memory: the
hidden layers of pairs, and the values of neighbours. Source: ours.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

BITS = tl.constexpr(32)  # Signs in a word
ROWS, COLUMNS = 8, 16  # Hand points and object points of a tile of pairs. Source: ours, timed
HIDDEN = 64  # Units of the first hidden layer that are multiplied at a time. Source: ours, timed
POINTS, CHANNELS = 32, 32  # Points and channels of a tile of neighbours. Source: ours, timed
EXACT, ROUNDED = "tf32x3", "tf32"
"""Products that are as exact as single precision, in three parts, and those whose factors have 10 bits."""
WARPS = 8  # Warps of a program on pairs. Source: ours, timed
PROGRAMS = 512  # Programs that keep a large card busy: small batches are split until there are so many. Source: ours


@triton.jit
def _tile(start_i, start_j, n, m, ROWS: tl.constexpr, COLUMNS: tl.constexpr):  # type: ignore[no-untyped-def]
    """Hand point and object point of each pair of a tile, and whether it is one."""
    pair = tl.arange(0, ROWS * COLUMNS)
    i, j = start_i + pair // COLUMNS, start_j + pair % COLUMNS
    return i, j, (i < n) & (j < m)


@triton.jit
def _first(hand, obj, i, j, h, side, n, m, width, inside):  # type: ignore[no-untyped-def]
    """The first hidden layer before its threshold, for pairs and some units; -1 outside."""
    mask = inside[:, None] & (h < width)[None, :]
    x = tl.load(hand + (side * n + i)[:, None] * width + h[None, :], mask=mask, other=-1.0)
    return x + tl.load(obj + (side * m + j)[:, None] * width + h[None, :], mask=mask, other=0.0)


@triton.jit
def _product(a, b, total, PRECISION: tl.constexpr):  # type: ignore[no-untyped-def]
    """total + a b."""
    if PRECISION == "bf16":
        return tl.dot(a.to(tl.bfloat16), b.to(tl.bfloat16), total)
    return tl.dot(a, b, total, input_precision=PRECISION)


@triton.jit
def _pairs_forward(  # type: ignore[no-untyped-def]
    hand, obj, weight, bias, last, out, signs, batch, n: tl.constexpr, m: tl.constexpr, width: tl.constexpr,
    outputs: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr, HIDDEN: tl.constexpr, OUTPUTS: tl.constexpr,
    PRECISION: tl.constexpr, KEEP: tl.constexpr,
):
    """One tile of pairs: both orders through both layers; keeps which units of the second layer are above zero."""
    sample, across = tl.program_id(1).to(tl.int64), tl.cdiv(m, COLUMNS)
    i, j, inside = _tile(tl.program_id(0) // across * ROWS, tl.program_id(0) % across * COLUMNS, n, m, ROWS, COLUMNS)
    k = tl.arange(0, OUTPUTS)
    from_last = tl.load(last + k, mask=k < outputs, other=0.0)
    total = tl.zeros([ROWS * COLUMNS], tl.float32)
    for order in range(2):
        side = order * batch + sample
        y = tl.zeros([ROWS * COLUMNS, OUTPUTS], tl.float32)
        for start in range(0, width, HIDDEN):
            h = start + tl.arange(0, HIDDEN)
            x = tl.maximum(_first(hand, obj, i, j, h, side, n, m, width, inside), 0.0)
            w = tl.load(weight + k[None, :] * width + h[:, None], mask=(k < outputs)[None, :] & (h < width)[:, None], other=0.0)
            y = _product(x, w, y, PRECISION)
        y += tl.load(bias + k, mask=k < outputs, other=0.0)[None, :]
        total += tl.sum(tl.maximum(y, 0.0) * from_last[None, :], 1)
        if KEEP:
            lane, word = tl.arange(0, BITS), tl.arange(0, OUTPUTS // BITS)
            above = tl.reshape((y > 0).to(tl.int32), [ROWS * COLUMNS, OUTPUTS // BITS, BITS])
            words = tl.sum(above << lane[None, None, :], 2)
            place = ((side * n + i) * m + j)[:, None] * (OUTPUTS // BITS) + word[None, :]
            tl.store(signs + place, words, mask=inside[:, None] & (word >= 0)[None, :])
    tl.store(out + (sample * n + i) * m + j, 0.5 * total, mask=inside)


@triton.jit
def _pairs_backward(  # type: ignore[no-untyped-def]
    hand, obj, weight, last, grad, signs, grad_hand, grad_obj, shares, counts, batch, n: tl.constexpr, m: tl.constexpr,
    width: tl.constexpr, outputs: tl.constexpr, steps: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr,
    HIDDEN: tl.constexpr, OUTPUTS: tl.constexpr, PRECISION: tl.constexpr,
):
    """Some units of the first layer, for some object points of a sample and all hand points.

    With s = 1 where a unit of the second layer is above zero, the gradient of a pair by the first layer is g (s * last) W. The
    gradients of weights follow from the sums over pairs of g s^T x (`shares`) and g s (`counts`).
    """
    sample, part = tl.program_id(2).to(tl.int64), tl.program_id(1)
    h, k = tl.program_id(0) * HIDDEN + tl.arange(0, HIDDEN), tl.arange(0, OUTPUTS)
    known = (k < outputs)[:, None] & (h < width)[None, :]
    w = tl.load(weight + k[:, None] * width + h[None, :], mask=known, other=0.0)
    w = w * tl.load(last + k, mask=k < outputs, other=0.0)[:, None]
    share, count = tl.zeros([OUTPUTS, HIDDEN], tl.float32), tl.zeros([OUTPUTS], tl.float32)
    for order in range(2):
        side = order * batch + sample
        for step in range(steps):
            start_j = (part * steps + step) * COLUMNS
            to_obj = tl.zeros([COLUMNS, HIDDEN], tl.float32)
            for start_i in range(0, n, ROWS):
                i, j, inside = _tile(start_i, start_j, n, m, ROWS, COLUMNS)
                x = _first(hand, obj, i, j, h, side, n, m, width, inside)
                g = 0.5 * tl.load(grad + (sample * n + i) * m + j, mask=inside, other=0.0)
                place = ((side * n + i) * m + j)[:, None] * (OUTPUTS // BITS) + (k // BITS)[None, :]
                words = tl.load(signs + place, mask=inside[:, None] & (k >= 0)[None, :], other=0)
                s = ((words >> (k % BITS)[None, :]) & 1).to(tl.float32)
                share = _product(tl.trans(s), g[:, None] * tl.maximum(x, 0.0), share, PRECISION)
                count += tl.sum(g[:, None] * s, 0)
                to_x = _product(s, w, tl.zeros([ROWS * COLUMNS, HIDDEN], tl.float32), PRECISION)
                to_x = tl.where(x > 0, g[:, None] * to_x, 0.0)
                to_x = tl.reshape(to_x, [ROWS, COLUMNS, HIDDEN])
                to_obj += tl.sum(to_x, 0)
                row = start_i + tl.arange(0, ROWS)
                tl.atomic_add(grad_hand + (side * n + row)[:, None] * width + h[None, :], tl.sum(to_x, 1),
                              mask=(row < n)[:, None] & (h < width)[None, :], sem="relaxed")
            column = start_j + tl.arange(0, COLUMNS)
            tl.store(grad_obj + (side * m + column)[:, None] * width + h[None, :], to_obj,
                     mask=(column < m)[:, None] & (h < width)[None, :])
    place = (sample * tl.num_programs(1) + part) * outputs + k
    tl.store(shares + place[:, None] * width + h[None, :], share, mask=known)
    tl.store(counts + place, count, mask=(k < outputs) & (tl.program_id(0) == 0))


class PairLayers(torch.autograd.Function):
    """Mean over both orders of the hidden layers' output, for every pair; twin of `distance_head.PairLayers`."""

    @staticmethod
    def forward(
        ctx: Any, hand: Float[Tensor, "2 b n h"], obj: Float[Tensor, "2 b m h"], weight: Float[Tensor, "k h"],
        bias: Float[Tensor, " k"], last: Float[Tensor, " k"], rounded: bool,
    ) -> Float[Tensor, "b n m"]:
        hand, obj, weight, bias, last = (t.contiguous() for t in (hand, obj, weight, bias, last))
        (_, b, n, width), m, outputs = hand.shape, obj.shape[2], len(weight)
        padded = max(32, triton.next_power_of_2(outputs))
        keep = any(ctx.needs_input_grad)
        signs = torch.empty(2, b, n, m, padded // 32 if keep else 0, dtype=torch.int32, device=hand.device)
        out = hand.new_empty(b, n, m)
        tiles = triton.cdiv(n, ROWS) * triton.cdiv(m, COLUMNS)
        ctx.precision = ROUNDED if rounded else EXACT
        _pairs_forward[(tiles, b)](
            hand, obj, weight, bias, last, out, signs, b, n, m, width, outputs, ROWS=ROWS, COLUMNS=COLUMNS, HIDDEN=HIDDEN,
            OUTPUTS=padded, PRECISION=ctx.precision, KEEP=keep, num_warps=WARPS)
        ctx.save_for_backward(hand, obj, weight, bias, last, signs)
        return out

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *grad_outputs: Float[Tensor, "b n m"]
    ) -> tuple[Float[Tensor, "..."] | None, ...]:
        hand, obj, weight, bias, last, signs = ctx.saved_tensors
        (_, b, n, width), m, outputs = hand.shape, obj.shape[2], len(weight)
        blocks = triton.cdiv(width, HIDDEN)
        parts = min(triton.cdiv(m, COLUMNS), max(1, PROGRAMS // (blocks * b)))
        steps = triton.cdiv(triton.cdiv(m, COLUMNS), parts)
        parts = triton.cdiv(m, COLUMNS * steps)
        grad_hand, grad_obj = torch.zeros_like(hand), torch.empty_like(obj)
        shares, counts = hand.new_empty(b * parts, outputs, width), hand.new_empty(b * parts, outputs)
        _pairs_backward[(blocks, parts, b)](
            hand, obj, weight, last, grad_outputs[0].contiguous(), signs, grad_hand, grad_obj, shares, counts, b, n, m, width,
            outputs, steps, ROWS=ROWS, COLUMNS=COLUMNS, HIDDEN=HIDDEN, OUTPUTS=signs.shape[-1] * 32, PRECISION=ctx.precision,
            num_warps=WARPS)
        share, count = shares.sum(0), counts.sum(0)
        # The second layer is linear where it is above zero, so its mean output follows from the same sums.
        grad_last = (weight * share).sum(1) + bias * count
        return grad_hand, grad_obj, last[:, None] * share, last * count, grad_last, None


@triton.jit
def _neighbours_forward(  # type: ignore[no-untyped-def]
    values, sign, index, highest, source, total, n: tl.constexpr, neighbours: tl.constexpr, width: tl.constexpr,
    POINTS: tl.constexpr, CHANNELS: tl.constexpr,
):
    """For some points and channels: highest value of sign * values among the neighbours, whose it is, and the sum of values."""
    sample = tl.program_id(2).to(tl.int64)
    point, channel = tl.program_id(0) * POINTS + tl.arange(0, POINTS), tl.program_id(1) * CHANNELS + tl.arange(0, CHANNELS)
    inside = (point < n)[:, None] & (channel < width)[None, :]
    signs = tl.load(sign + channel, mask=channel < width, other=1.0)[None, :]
    best = tl.full([POINTS, CHANNELS], float("-inf"), tl.float32)
    whose = tl.zeros([POINTS, CHANNELS], tl.int16)
    added = tl.zeros([POINTS, CHANNELS], tl.float32)
    for j in range(neighbours):
        other = tl.load(index + (sample * n + point) * neighbours + j, mask=point < n, other=0)
        value = tl.load(values + (sample * n + other)[:, None] * width + channel[None, :], mask=inside, other=0.0)
        added += value
        better = value * signs > best
        best = tl.where(better, value * signs, best)
        whose = tl.where(better, other.to(tl.int16)[:, None], whose)
    place = (sample * n + point)[:, None] * width + channel[None, :]
    tl.store(highest + place, best * signs, mask=inside)
    tl.store(source + place, whose, mask=inside)
    tl.store(total + place, added, mask=inside)


@triton.jit
def _neighbours_backward(  # type: ignore[no-untyped-def]
    grad, source, out, n: tl.constexpr, width: tl.constexpr, count, BLOCK: tl.constexpr,
):
    """Add each gradient to the point whose value was the highest."""
    place = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = place < count
    g = tl.load(grad + place, mask=inside, other=0.0)
    whose = tl.load(source + place, mask=inside, other=0).to(tl.int64)
    first = place // (n * width) * n
    tl.atomic_add(out + (first + whose) * width + place % width, g, mask=inside, sem="relaxed")


class Neighbours(torch.autograd.Function):
    """Among each point's neighbours, the value that a sign makes the highest, and the sum of the values."""

    @staticmethod
    def forward(
        ctx: Any, values: Float[Tensor, "b n d"], sign: Float[Tensor, " d"], index: Int[Tensor, "b n k"],
        adjacency: Float[Tensor, "b n n"] | None,
    ) -> tuple[Float[Tensor, "b n d"], Float[Tensor, "b n d"]]:
        """The index has 32 bits. `adjacency` has 1 for each edge; without it, the sum has no gradient."""
        values, ctx.mixed = values.contiguous(), torch.is_autocast_enabled(values.device.type)
        b, n, width = values.shape
        highest, total = torch.empty_like(values), torch.empty_like(values)
        source = torch.empty(values.shape, dtype=torch.int16, device=values.device)
        grid = (triton.cdiv(n, POINTS), triton.cdiv(width, CHANNELS), b)
        _neighbours_forward[grid](
            values, sign.contiguous(), index, highest, source, total, n, index.shape[2], width, POINTS=POINTS,
            CHANNELS=CHANNELS)
        ctx.save_for_backward(source, adjacency)
        if adjacency is None:
            ctx.mark_non_differentiable(total)
        return highest, total

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *grad_outputs: Float[Tensor, "b n d"]
    ) -> tuple[Float[Tensor, "b n d"] | None, ...]:
        source, adjacency = ctx.saved_tensors
        of_highest, of_total = grad_outputs
        with torch.autocast(source.device.type, torch.bfloat16, enabled=ctx.mixed):
            out = torch.zeros_like(of_highest) if adjacency is None else (adjacency.mT @ of_total).float()
        _, n, width = source.shape
        block = 1024
        _neighbours_backward[(triton.cdiv(source.numel(), block),)](
            of_highest.contiguous(), source, out, n, width, source.numel(), BLOCK=block)
        return out, None, None, None


def try_out() -> None:
    """Run both kernels once on a few values, which also shows whether they compile here."""
    device = torch.device("cuda", torch.cuda.current_device())
    sides, weight = torch.ones(2, 1, 4, 4, device=device), torch.ones(4, 4, device=device)
    pairs = PairLayers.apply(sides, sides, weight, weight[0], weight[0], False)
    highest, _ = Neighbours.apply(sides[0], weight[0], torch.zeros(1, 4, 1, dtype=torch.int32, device=device), None)
    if not bool((pairs == 36).all() & (highest == 1).all()):  # type: ignore[operator]
        raise RuntimeError("a kernel is wrong here")
