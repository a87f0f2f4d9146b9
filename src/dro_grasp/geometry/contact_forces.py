"""Forces at contacts, for many grasps at once: edges of friction cones, and amounts along them that are not negative."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dro_grasp.graphs import repeat

GRAVITY = 9.81  # [m/s^2]
LEVER = 0.05  # Lever that makes a torque comparable with a force [m] (ours)


def nonnegative_least_squares(
    a: Float[Tensor, "n m k"], b: Float[Tensor, "n m *c"], ridge: float, iterations: int
) -> Float[Tensor, "n k *c"]:
    """Minimise |a x - b|^2 + ridge |x|^2 over x >= 0, for n problems at once. Source: Beck and Teboulle 2009 (FISTA).

    With a last axis, b has c columns, each with its own x.
    """
    if b.ndim == 2:
        return nonnegative_least_squares(a, b[..., None], ridge, iterations)[..., 0]
    hessian = a.mT @ a + ridge * torch.eye(a.shape[-1], dtype=a.dtype, device=a.device)
    slope = a.mT @ b
    step = 1 / hessian.abs().sum(-1).amax(-1)[:, None, None]  # at most one over the largest eigenvalue
    pull = _momenta(iterations, slope)

    def advance(
        state: tuple[Float[Tensor, "n k *c"], Float[Tensor, "n k *c"]], number: Int[Tensor, "1"]
    ) -> tuple[Float[Tensor, "n k *c"], Float[Tensor, "n k *c"]]:
        x, ahead = state
        new = (ahead - step * (hessian @ ahead - slope)).clamp_min(0)
        return new, new + pull.index_select(0, number) * (new - x)

    none = torch.zeros_like(slope)
    return repeat(advance, (none, none), iterations)[0]


def _momenta(iterations: int, like: Float[Tensor, "..."]) -> Float[Tensor, " iterations"]:
    """How far each iteration looks ahead, as a share of its step."""
    momentum, found = 1.0, []
    for _ in range(iterations):
        following = (1 + math.sqrt(1 + 4 * momentum**2)) / 2
        found.append((momentum - 1) / following)
        momentum = following
    return torch.tensor(found, dtype=torch.float64).to(like)


def friction_cone(inward: Float[Tensor, "*n 3"], friction: float, edges: int) -> Float[Tensor, "*n edges 3"]:
    """Edges of the friction cones about unit directions, with a normal component of one."""
    helper = torch.eye(3, dtype=inward.dtype, device=inward.device)[inward.abs().argmin(-1)]
    first = torch.nn.functional.normalize(torch.linalg.cross(inward, helper), dim=-1)
    second = torch.linalg.cross(inward, first)
    angle = torch.arange(edges, dtype=inward.dtype, device=inward.device) * (2 * math.pi / edges)
    around = angle.cos()[:, None] * first[..., None, :] + angle.sin()[:, None] * second[..., None, :]
    return inward[..., None, :] + friction * around
