"""Fused kernels of the network for CUDA, in Triton: what `distance_head` and `encoder` compute elsewhere in several passes.

Imported only where there is a CUDA device and Triton. Both kernels keep in registers what the plain form writes to memory: the
hidden layers of pairs, and the values of neighbours. Source: ours.
"""

# pyright: reportMissingImports=false, reportIndexIssue=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportGeneralTypeIssues=false
from __future__ import annotations

import os
from typing import Any

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

BITS = tl.constexpr(32)
"""Signs in a word."""
ROWS = 4
"""Hand points of a tile of pairs. Source: ours, timed."""
COLUMNS = 16
"""Object points of a tile of pairs. Source: ours, timed."""
HIDDEN = 64
"""Units of the first hidden layer that are multiplied at a time. Source: ours, timed."""
WARPS = 4
"""Warps of a program on pairs. Source: ours, timed."""
COUNTED = 64
"""Pairs whose signs are counted at a time. Source: ours."""
POINTS = 32
"""Points of a tile of neighbours. Source: ours, timed."""
CHANNELS = 32
"""Channels of a tile of neighbours. Source: ours, timed."""
LINES = 32
"""Rows of a tile of points and channels. Source: ours."""
STEPS = tl.constexpr(8)
"""Tiles that a program sums up. Source: ours."""
SCATTERED = 1024
"""Gradients that a program adds to neighbours. Source: ours."""
BACK = {1: 64, 3: 32}
"""Units of the first hidden layer in the backward pass, by the parts of its products. Source: ours, by registers."""
SIDE = 64
"""Object points of the backward pass, each with one hand point at a time. Source: ours, timed."""
COMPARED = 4096
"""Distances that a program on nearest points keeps. Source: ours."""
EXACT = "tf32x3"
"""Products as exact as single precision, in three parts."""
ROUNDED = "bf16"
"""Products of factors with 8 bits, summed in single precision."""

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
"""Whether kernels are interpreted on the CPU, as tests do."""


@triton.jit
def _product(a, b, total, PRECISION: tl.constexpr):  # type: ignore[no-untyped-def]
    """The sum of total and a b."""
    if PRECISION == "bf16":
        result = tl.dot(a.to(tl.bfloat16), b.to(tl.bfloat16), total)
    else:
        result = tl.dot(a, b, total, input_precision=PRECISION)
    return result


@triton.jit
def _signed_product(s, b, total, PARTS: tl.constexpr):  # type: ignore[no-untyped-def]
    """The sum of total and s b, where s has 0 and 1 alone, and b counts to so many times 8 bits."""
    if PARTS == 0:  # Triton's interpreter cannot multiply in bfloat16
        result = tl.dot(s, b, total, input_precision="ieee")
    else:
        result = total
        for _ in tl.static_range(PARTS):
            part = b.to(tl.bfloat16)
            result = tl.dot(s.to(tl.bfloat16), part, result)
            b -= part.to(tl.float32)
    return result


@triton.jit
def _first(hand, obj, i, j, h, side, n, m, width):  # type: ignore[no-untyped-def]
    """The first hidden layer before its threshold: hand points i with object points j, one row a pair."""
    known = (h < width)[None, :]
    a = tl.load(hand + (side * n + i)[:, None] * width + h[None, :], mask=(i < n)[:, None] & known, other=0.0)
    b = tl.load(obj + (side * m + j)[:, None] * width + h[None, :], mask=(j < m)[:, None] & known, other=0.0)
    return tl.reshape(a[:, None, :] + b[None, :, :], [i.shape[0] * j.shape[0], h.shape[0]])


@triton.jit
def _places(i, j, n, m):  # type: ignore[no-untyped-def]
    """Place of each pair in a sample, and whether there is one."""
    place, inside = i[:, None] * m + j[None, :], (i < n)[:, None] & (j < m)[None, :]
    return tl.reshape(place, [i.shape[0] * j.shape[0]]), tl.reshape(inside, [i.shape[0] * j.shape[0]])


@triton.jit
def _pairs_forward(  # type: ignore[no-untyped-def]
    hand, obj, weight, bias, last, out, signs, batch, n: tl.constexpr, m: tl.constexpr, width: tl.constexpr,
    outputs: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr, HIDDEN: tl.constexpr, OUTPUTS: tl.constexpr,
    PRECISION: tl.constexpr, KEEP: tl.constexpr,
):
    """One tile of pairs: both orders through both layers; keeps which units of the second layer are above zero."""
    sample, across = tl.program_id(1).to(tl.int64), tl.cdiv(m, COLUMNS)
    i = tl.program_id(0) // across * ROWS + tl.arange(0, ROWS)
    j = tl.program_id(0) % across * COLUMNS + tl.arange(0, COLUMNS)
    place, inside = _places(i, j, n, m)
    k = tl.arange(0, OUTPUTS)
    from_last = tl.load(last + k, mask=k < outputs, other=0.0)
    total = tl.zeros([ROWS * COLUMNS], tl.float32)
    for order in range(2):
        side = order * batch + sample
        y = tl.zeros([ROWS * COLUMNS, OUTPUTS], tl.float32)
        for start in range(0, width, HIDDEN):
            h = start + tl.arange(0, HIDDEN)
            x = tl.maximum(_first(hand, obj, i, j, h, side, n, m, width), 0.0)
            w = tl.load(weight + k[None, :] * width + h[:, None], mask=(k < outputs)[None, :] & (h < width)[:, None], other=0.0)
            y = _product(x, w, y, PRECISION)
        y += tl.load(bias + k, mask=k < outputs, other=0.0)[None, :]
        total += tl.sum(tl.maximum(y, 0.0) * from_last[None, :], 1)
        if KEEP:
            lane, word = tl.arange(0, BITS), tl.arange(0, OUTPUTS // BITS)
            above = tl.reshape((y > 0).to(tl.int32), [ROWS * COLUMNS, OUTPUTS // BITS, BITS])
            words = tl.sum(above << lane[None, None, :], 2)
            to = (side * n * m + place)[:, None] * (OUTPUTS // BITS) + word[None, :]
            tl.store(signs + to, words, mask=inside[:, None] & (word >= 0)[None, :])
    tl.store(out + sample * n * m + place, 0.5 * total, mask=inside)


@triton.jit
def _above(signs, first, place, inside, OUTPUTS: tl.constexpr):  # type: ignore[no-untyped-def]
    """1 where a unit of the second layer is above zero, for pairs, else 0."""
    lane, word = tl.arange(0, BITS), tl.arange(0, OUTPUTS // BITS)
    where = (first + place)[:, None] * (OUTPUTS // BITS) + word[None, :]
    words = tl.load(signs + where, mask=inside[:, None] & (word >= 0)[None, :], other=0)
    return tl.reshape(((words[:, :, None] >> lane[None, None, :]) & 1).to(tl.float32), [place.shape[0], OUTPUTS])


@triton.jit
def _pairs_backward(  # type: ignore[no-untyped-def]
    hand, obj, weight, last, grad, signs, grad_hand, grad_obj, shares, batch, n: tl.constexpr, m: tl.constexpr,
    width: tl.constexpr, outputs: tl.constexpr, SIDE: tl.constexpr, HIDDEN: tl.constexpr, OUTPUTS: tl.constexpr,
    PARTS: tl.constexpr,
):
    """Some units of the first layer, for some object points of a sample and one hand point after the other.

    With s = 1 where a unit of the second layer is above zero, the gradient of a pair by the first layer is g (s * last) W. The
    gradients of weights follow from the sums over pairs of g s^T x (`shares`) and g s (`_pairs_counts`).
    """
    sample, part = tl.program_id(2).to(tl.int64), tl.program_id(1)
    h, k, j = tl.program_id(0) * HIDDEN + tl.arange(0, HIDDEN), tl.arange(0, OUTPUTS), part * SIDE + tl.arange(0, SIDE)
    known, there = (k < outputs)[:, None] & (h < width)[None, :], (j < m)[:, None] & (h < width)[None, :]
    w = tl.load(weight + k[:, None] * width + h[None, :], mask=known, other=0.0)
    w = w * tl.load(last + k, mask=k < outputs, other=0.0)[:, None]
    share = tl.zeros([OUTPUTS, HIDDEN], tl.float32)
    for order in range(2):
        side = order * batch + sample
        own = tl.load(obj + (side * m + j)[:, None] * width + h[None, :], mask=there, other=0.0)
        to_obj = tl.zeros([SIDE, HIDDEN], tl.float32)
        for i in range(n):
            x = own + tl.load(hand + (side * n + i) * width + h, mask=h < width, other=0.0)[None, :]
            g = 0.5 * tl.load(grad + (sample * n + i) * m + j, mask=j < m, other=0.0)
            s = _above(signs, side * n * m, i * m + j, j < m, OUTPUTS)
            share = _signed_product(tl.trans(s), g[:, None] * tl.maximum(x, 0.0), share, PARTS)
            to_x = _signed_product(s, w, tl.zeros([SIDE, HIDDEN], tl.float32), PARTS)
            to_x = tl.where(x > 0, g[:, None] * to_x, 0.0)
            to_obj += to_x
            tl.atomic_add(grad_hand + (side * n + i) * width + h, tl.sum(to_x, 0), mask=h < width, sem="relaxed")
        tl.store(grad_obj + (side * m + j)[:, None] * width + h[None, :], to_obj, mask=there)
    to = (sample * tl.num_programs(1) + part) * outputs + k
    tl.store(shares + to[:, None] * width + h[None, :], share, mask=known)


@triton.jit
def _pairs_counts(  # type: ignore[no-untyped-def]
    grad, signs, counts, batch, pairs: tl.constexpr, outputs: tl.constexpr, COUNTED: tl.constexpr, OUTPUTS: tl.constexpr,
):
    """Sum of half the gradients of a sample's pairs, in both orders, where a unit of the second layer is above zero."""
    sample, k = tl.program_id(0).to(tl.int64), tl.arange(0, OUTPUTS)
    total = tl.zeros([COUNTED, OUTPUTS], tl.float32)
    for start in range(0, pairs, COUNTED):
        place = start + tl.arange(0, COUNTED)
        inside = place < pairs
        g = 0.5 * tl.load(grad + sample * pairs + place, mask=inside, other=0.0)
        for order in range(2):
            total += g[:, None] * _above(signs, (order * batch + sample) * pairs, place, inside, OUTPUTS)
    tl.store(counts + sample * outputs + k, tl.sum(total, 0), mask=k < outputs)


class PairLayers(torch.autograd.Function):
    """Mean over both orders of the hidden layers' output, for every pair; twin of `distance_head.PairLayers`."""

    @staticmethod
    def forward(  # noqa: D102
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
        ctx.parts = 1 if rounded else 3
        _pairs_forward[(tiles, b)](
            hand, obj, weight, bias, last, out, signs, b, n, m, width, outputs, ROWS=ROWS, COLUMNS=COLUMNS, HIDDEN=HIDDEN,
            OUTPUTS=padded, PRECISION=ROUNDED if rounded and not INTERPRETED else EXACT, KEEP=keep, num_warps=WARPS,
            num_stages=1)
        ctx.save_for_backward(hand, obj, weight, bias, last, signs)
        return out

    @staticmethod
    @once_differentiable
    def backward(  # noqa: D102  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *grad_outputs: Float[Tensor, "b n m"]
    ) -> tuple[Float[Tensor, "..."] | None, ...]:
        hand, obj, weight, bias, last, signs = ctx.saved_tensors
        (_, b, n, width), m, outputs = hand.shape, obj.shape[2], len(weight)
        parts = triton.cdiv(m, SIDE)
        grad_hand, grad_obj = torch.zeros_like(hand), torch.empty_like(obj)
        shares, counts = hand.new_empty(b * parts, outputs, width), hand.new_empty(b, outputs)
        grad, padded = grad_outputs[0].contiguous(), signs.shape[-1] * 32
        hidden = BACK[ctx.parts]
        _pairs_backward[(triton.cdiv(width, hidden), parts, b)](
            hand, obj, weight, last, grad, signs, grad_hand, grad_obj, shares, b, n, m, width, outputs, SIDE=SIDE,
            HIDDEN=hidden, OUTPUTS=padded, PARTS=0 if INTERPRETED else ctx.parts, num_warps=WARPS, num_stages=1)
        _pairs_counts[(b,)](grad, signs, counts, b, n * m, outputs, COUNTED=COUNTED, OUTPUTS=padded)
        share, count = shares.sum(0), counts.sum(0)
        # The second layer is linear where it is above zero, so its mean output follows from the same sums.
        grad_last = (weight * share).sum(1) + bias * count
        return grad_hand, grad_obj, last[:, None] * share, last * count, grad_last, None


@triton.jit
def _nearest(  # type: ignore[no-untyped-def]
    points, index, n: tl.constexpr, k: tl.constexpr, POINTS: tl.constexpr, PADDED: tl.constexpr,
):
    """The k nearest points of some points, the nearest first: the least distance is found, and then left out."""
    sample = tl.program_id(1).to(tl.int64)
    i, j = tl.program_id(0) * POINTS + tl.arange(0, POINTS), tl.arange(0, PADDED)
    squared = tl.zeros([POINTS, PADDED], tl.float32)
    for axis in tl.static_range(3):
        a = tl.load(points + (sample * n + i) * 3 + axis, mask=i < n, other=0.0)
        b = tl.load(points + (sample * n + j) * 3 + axis, mask=j < n, other=0.0)
        squared += (a[:, None] - b[None, :]) * (a[:, None] - b[None, :])
    squared = tl.where((j < n)[None, :], squared, float("inf"))
    for rank in range(k):
        least = tl.argmin(squared, 1)
        tl.store(index + (sample * n + i) * k + rank, least, mask=i < n)
        squared = tl.where(j[None, :] == least[:, None], float("inf"), squared)


def nearest(points: Float[Tensor, "b n 3"], k: int) -> Int[Tensor, "b n k"]:
    """Indices of the k nearest points of each point, itself included, the nearest first."""
    b, n, _ = points.shape
    padded = triton.next_power_of_2(n)
    index = torch.empty(b, n, k, dtype=torch.int32, device=points.device)
    some = max(1, COMPARED // padded)
    _nearest[(triton.cdiv(n, some), b)](points.contiguous(), index, n, k, POINTS=some, PADDED=padded)
    return index


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


@triton.jit
def _tile_of(rows, width: tl.constexpr, step, LINES: tl.constexpr, CHANNELS: tl.constexpr):  # type: ignore[no-untyped-def]
    """Rows and places of a tile of points and channels, whether they are there, and the channels."""
    row = tl.program_id(1).to(tl.int64) * STEPS * LINES + step * LINES + tl.arange(0, LINES)
    channel = tl.program_id(0) * CHANNELS + tl.arange(0, CHANNELS)
    return row, row[:, None] * width + channel[None, :], (row < rows)[:, None] & (channel < width)[None, :], channel


@triton.jit
def _edge_means(  # type: ignore[no-untyped-def]
    values, own, degree, sums, rows, width: tl.constexpr, LINES: tl.constexpr, CHANNELS: tl.constexpr,
):
    """Sums over some rows of the values, as often as they are neighbours, and of own values."""
    of_values, of_own = tl.zeros([CHANNELS], tl.float32), tl.zeros([CHANNELS], tl.float32)
    for step in range(STEPS):
        row, place, inside, channel = _tile_of(rows, width, step, LINES, CHANNELS)
        often = tl.load(degree + row, mask=row < rows, other=0.0)[:, None]
        of_values += tl.sum(often * tl.load(values + place, mask=inside, other=0.0), 0)
        of_own += tl.sum(tl.load(own + place, mask=inside, other=0.0), 0)
    channel = tl.program_id(0) * CHANNELS + tl.arange(0, CHANNELS)
    to = tl.program_id(1) * 2 * width + channel
    tl.store(sums + to, of_values, mask=channel < width)
    tl.store(sums + to + width, of_own, mask=channel < width)


@triton.jit
def _edge_squares(  # type: ignore[no-untyped-def]
    values, own, total, degree, means, sums, rows, width: tl.constexpr, k: tl.constexpr, LINES: tl.constexpr,
    CHANNELS: tl.constexpr,
):
    """Sum over the edges of some rows of (value + own - mean)^2, of centred values: large sums would lose digits."""
    squares = tl.zeros([CHANNELS], tl.float32)
    channel = tl.program_id(0) * CHANNELS + tl.arange(0, CHANNELS)
    mean_value = tl.load(means + channel, mask=channel < width, other=0.0)[None, :]
    mean_own = tl.load(means + width + channel, mask=channel < width, other=0.0)[None, :]
    for step in range(STEPS):
        row, place, inside, _ = _tile_of(rows, width, step, LINES, CHANNELS)
        often = tl.load(degree + row, mask=row < rows, other=0.0)[:, None]
        left = tl.load(values + place, mask=inside, other=0.0) - mean_value
        right = tl.load(own + place, mask=inside, other=0.0) - mean_own
        around = tl.load(total + place, mask=inside, other=0.0) - k * mean_value
        squares += tl.sum(tl.where(inside, often * left * left + k * right * right + 2 * right * around, 0.0), 0)
    tl.store(sums + tl.program_id(1) * width + channel, squares, mask=channel < width)


@triton.jit
def _edge_out(  # type: ignore[no-untyped-def]
    highest, own, scale, shift, out, rows, width: tl.constexpr, SLOPE: tl.constexpr, LINES: tl.constexpr,
    CHANNELS: tl.constexpr,
):
    """LeakyReLU of scaled and shifted values."""
    for step in range(STEPS):
        _, place, inside, channel = _tile_of(rows, width, step, LINES, CHANNELS)
        a = tl.load(scale + channel, mask=channel < width, other=0.0)[None, :]
        b = tl.load(shift + channel, mask=channel < width, other=0.0)[None, :]
        x = tl.load(highest + place, mask=inside, other=0.0) + tl.load(own + place, mask=inside, other=0.0)
        tl.store(out + place, tl.where(x * a + b > 0, x * a + b, SLOPE * (x * a + b)), mask=inside)


@triton.jit
def _edge_slopes(  # type: ignore[no-untyped-def]
    grad, highest, own, scale, shift, means, sums, centred, rows, width: tl.constexpr, SLOPE: tl.constexpr,
    LINES: tl.constexpr, CHANNELS: tl.constexpr,
):
    """Sums over some rows of the gradient before LeakyReLU, and of its product with what is scaled; centred own values."""
    plain, scaled = tl.zeros([CHANNELS], tl.float32), tl.zeros([CHANNELS], tl.float32)
    for step in range(STEPS):
        _, place, inside, channel = _tile_of(rows, width, step, LINES, CHANNELS)
        a = tl.load(scale + channel, mask=channel < width, other=0.0)[None, :]
        b = tl.load(shift + channel, mask=channel < width, other=0.0)[None, :]
        mean_own = tl.load(means + width + channel, mask=channel < width, other=0.0)[None, :]
        mine = tl.load(own + place, mask=inside, other=0.0)
        x = tl.load(highest + place, mask=inside, other=0.0) + mine
        g = tl.load(grad + place, mask=inside, other=0.0)
        g = tl.where(x * a + b > 0, g, SLOPE * g)
        plain += tl.sum(g, 0)
        scaled += tl.sum(g * x, 0)
        tl.store(centred + place, (mine - mean_own).to(centred.dtype.element_ty), mask=inside)
    channel = tl.program_id(0) * CHANNELS + tl.arange(0, CHANNELS)
    to = tl.program_id(1) * 2 * width + channel
    tl.store(sums + to, plain, mask=channel < width)
    tl.store(sums + to + width, scaled, mask=channel < width)


@triton.jit
def _edge_gradients(  # type: ignore[no-untyped-def]
    grad, highest, own, total, values, degree, around, scale, shift, means, by_mean, by_variance, through, to_own, to_values,
    rows, width: tl.constexpr, k: tl.constexpr, SLOPE: tl.constexpr, LINES: tl.constexpr, CHANNELS: tl.constexpr,
):
    """Gradients by own values, and those by values that do not come through the maximum; `through` is the part that does."""
    for step in range(STEPS):
        row, place, inside, channel = _tile_of(rows, width, step, LINES, CHANNELS)
        known = channel < width
        a = tl.load(scale + channel, mask=known, other=0.0)[None, :]
        b = tl.load(shift + channel, mask=known, other=0.0)[None, :]
        mean_value = tl.load(means + channel, mask=known, other=0.0)[None, :]
        mean_own = tl.load(means + width + channel, mask=known, other=0.0)[None, :]
        d_mean = tl.load(by_mean + channel, mask=known, other=0.0)[None, :]
        d_square = 2 * tl.load(by_variance + channel, mask=known, other=0.0)[None, :]
        often = tl.load(degree + row, mask=row < rows, other=0.0)[:, None]
        mine = tl.load(own + place, mask=inside, other=0.0)
        x = tl.load(highest + place, mask=inside, other=0.0) + mine
        g = tl.load(grad + place, mask=inside, other=0.0)
        g = tl.where(x * a + b > 0, g, SLOPE * g) * a
        near = tl.load(total + place, mask=inside, other=0.0) - k * mean_value
        tl.store(through + place, g, mask=inside)
        tl.store(to_own + place, g + k * d_mean + d_square * (k * (mine - mean_own) + near), mask=inside)
        value = tl.load(values + place, mask=inside, other=0.0) - mean_value
        others = tl.load(around + place, mask=inside, other=0.0).to(tl.float32)
        tl.store(to_values + place, often * d_mean + d_square * (often * value + others), mask=inside)


def _maxima(
    values: Float[Tensor, "b n d"], sign: Float[Tensor, " d"], index: Int[Tensor, "b n k"]
) -> tuple[Float[Tensor, "b n d"], Int[Tensor, "b n d"], Float[Tensor, "b n d"]]:
    """Highest values of sign * values among neighbours, whose they are, and sums of the values."""
    b, n, width = values.shape
    highest, total = torch.empty_like(values), torch.empty_like(values)
    source = torch.empty(values.shape, dtype=torch.int16, device=values.device)
    grid = (triton.cdiv(n, POINTS), triton.cdiv(width, CHANNELS), b)
    _neighbours_forward[grid](
        values, sign, index, highest, source, total, n, index.shape[2], width, POINTS=POINTS, CHANNELS=CHANNELS)
    return highest, source, total


def highest_neighbours(
    values: Float[Tensor, "b n d"], sign: Float[Tensor, " d"], index: Int[Tensor, "b n k"]
) -> Float[Tensor, "b n d"]:
    """Among each point's neighbours, the value that a sign makes the highest; without a gradient."""
    return _maxima(values.contiguous(), sign.contiguous(), index)[0]


class EdgeMaximum(torch.autograd.Function):
    """LeakyReLU(BatchNorm(value of a neighbour + own)), the highest over neighbours, with the statistics of all edges.

    In twelve passes over points where autograd takes some seventy.
    """

    @staticmethod
    def forward(  # noqa: D102
        ctx: Any, values: Float[Tensor, "b n d"], own: Float[Tensor, "b n d"], weight: Float[Tensor, " d"],
        bias: Float[Tensor, " d"], index: Int[Tensor, "b n k"], degree: Float[Tensor, "b n 1"],
        adjacency: Float[Tensor, "b n n"], eps: float, slope: float,
    ) -> tuple[Float[Tensor, "b n d"], Float[Tensor, " d"], Float[Tensor, " d"]]:
        values, own, degree = values.contiguous(), own.contiguous(), degree.contiguous()
        highest, source, total = _maxima(values, torch.where(weight < 0, -1.0, 1.0), index)
        rows, width, k, edges = degree.numel(), values.shape[2], index.shape[2], index.numel()
        grid, sizes = _over_rows(rows, width), {"LINES": LINES, "CHANNELS": CHANNELS}
        sums = values.new_empty(grid[1], 2, width)
        _edge_means[grid](values, own, degree, sums, rows, width, **sizes)
        means = sums.sum(0)
        means[0] /= edges
        means[1] /= rows
        squares = values.new_empty(grid[1], width)
        _edge_squares[grid](values, own, total, degree, means, squares, rows, width, k, **sizes)
        mean, variance = means.sum(0), squares.sum(0) / edges
        root = torch.rsqrt(variance + eps)
        scale = weight * root
        shift, out = bias - mean * scale, torch.empty_like(values)
        _edge_out[grid](highest, own, scale, shift, out, rows, width, SLOPE=slope, **sizes)
        ctx.save_for_backward(values, own, highest, source, total, degree, adjacency, weight, means, root, scale, shift)
        ctx.neighbours, ctx.slope, ctx.mixed = k, slope, torch.is_autocast_enabled(values.device.type)
        ctx.mark_non_differentiable(mean, variance)
        return out, mean, variance

    @staticmethod
    @once_differentiable
    def backward(  # noqa: D102  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *grad_outputs: Float[Tensor, "..."]
    ) -> tuple[Float[Tensor, "..."] | None, ...]:
        values, own, highest, source, total, degree, adjacency, weight, means, root, scale, shift = ctx.saved_tensors
        grad, (_, n, width), rows, k = grad_outputs[0].contiguous(), values.shape, degree.numel(), ctx.neighbours
        grid, sizes = _over_rows(rows, width), {"SLOPE": ctx.slope, "LINES": LINES, "CHANNELS": CHANNELS}
        kind = torch.bfloat16 if ctx.mixed else torch.float32
        sums, centred = values.new_empty(grid[1], 2, width), torch.empty_like(own, dtype=kind)
        _edge_slopes[grid](grad, highest, own, scale, shift, means, sums, centred, rows, width, **sizes)
        plain, scaled = sums.sum(0)
        by_scale = scaled - means.sum(0) * plain
        by_mean, by_variance = -scale * plain / (rows * k), -0.5 * by_scale * weight * root**3 / (rows * k)
        around = adjacency.mT.to(kind) @ centred
        through, to_own, to_values = torch.empty_like(own), torch.empty_like(own), torch.empty_like(own)
        _edge_gradients[grid](
            grad, highest, own, total, values, degree, around, scale, shift, means, by_mean, by_variance, through, to_own,
            to_values, rows, width, k, **sizes)
        _neighbours_backward[(triton.cdiv(source.numel(), SCATTERED),)](
            through, source, to_values, n, width, source.numel(), BLOCK=SCATTERED)
        return to_values, to_own, by_scale * root, plain, None, None, None, None, None


def _over_rows(rows: int, width: int) -> tuple[int, int]:
    """Programs over channels and over rows."""
    return triton.cdiv(width, CHANNELS), triton.cdiv(rows, LINES * STEPS.value)


def try_out() -> None:
    """Run both kernels once on a few values, which also shows whether they compile here."""
    device = torch.device("cuda", torch.cuda.current_device())
    sides, weight = torch.ones(2, 1, 4, 4, device=device), torch.ones(4, 4, device=device)
    pairs = PairLayers.apply(sides, sides, weight, weight[0], weight[0], False)
    highest = highest_neighbours(sides[0], weight[0], torch.zeros(1, 4, 1, dtype=torch.int32, device=device))
    if not bool((pairs == 36).all() & (highest == 1).all()):  # type: ignore[operator]
        raise RuntimeError("a kernel is wrong here")
