"""Cross-attention between hand and object: one encoder and one decoder layer. Source: paper section III-C."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional


class Attention(nn.Module):
    """Multi-head attention of queries to a memory."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, width)
        self.memory = nn.Linear(width, 2 * width)
        self.output = nn.Linear(width, width)

    def forward(self, x: Float[Tensor, "b n c"], memory: Float[Tensor, "b m c"]) -> Float[Tensor, "b n c"]:
        """Attended values."""
        query = self.query(x).unflatten(-1, (self.heads, -1)).transpose(1, 2)
        key, value = (
            part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in self.memory(memory).chunk(2, -1)
        )
        if query.is_cuda or not torch.is_grad_enabled():
            mixed = functional.scaled_dot_product_attention(query, key, value)
        else:
            # On a CPU at these sizes the fused kernel is faster forwards, but several times slower backwards.
            scores = query @ key.mT / query.shape[-1] ** 0.5
            mixed = scores.softmax(-1) @ value
        return self.output(mixed.transpose(1, 2).flatten(2))


class FeedForward(nn.Sequential):
    """Two linear layers."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__(nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, width))


class CrossTransformer(nn.Module):
    """Relates one cloud's features to another's; no positional encoding, since points carry none.

    The memory passes a self-attention layer, the queries a self-attention and a cross-attention layer, each with
    residual and layer normalisation.
    """

    def __init__(self, width: int, heads: int, hidden: int) -> None:
        super().__init__()
        self.memory_attention, self.memory_forward = Attention(width, heads), FeedForward(width, hidden)
        self.self_attention, self.cross_attention = Attention(width, heads), Attention(width, heads)
        self.forward_layer = FeedForward(width, hidden)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(7))

    def forward(self, x: Float[Tensor, "b n c"], memory: Float[Tensor, "b m c"]) -> Float[Tensor, "b n c"]:
        """Features of x that know the memory; the caller adds the paper's residual."""
        memory = self.norms[0](memory + self.memory_attention(memory, memory))
        memory = self.norms[2](self.norms[1](memory + self.memory_forward(memory)))
        x = self.norms[3](x + self.self_attention(x, x))
        x = self.norms[4](x + self.cross_attention(x, memory))
        return self.norms[6](self.norms[5](x + self.forward_layer(x)))
