"""Which side of a flat object each point of a rigid body lies on.

Distances to a flat cloud leave every point two positions, mirrored in its plane. The body's own shape tells them
apart: a body cannot be mirrored.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.geometry.registration import register
from dro_grasp.geometry.se3 import apply_to_cloud


@dataclass(frozen=True)
class SideConfig:
    """Numbers of the choice."""

    rounds: int = 4
    """How often each point picks its nearer candidate and the body is registered again."""
    reference_margin: float = 0.8
    """Factor on the error of what lies mostly on the reference body's side: it wins when both sides fit alike."""
    ridge: float = 1e-6
    """Regularises the fit of the heights, in units of the body's size."""


@torch.no_grad()
def choose_sides(
    local: Float[Tensor, "l p 3"],
    weight: Float[Tensor, "l p"],
    candidates: Float[Tensor, "b 2 l p 3"],
    misfit: Float[Tensor, "b 2 l p"],
    reference: int,
    config: SideConfig | None = None,
) -> Bool[Tensor, "b l p"]:
    """For each point, whether its second candidate is the right one.

    Each body is registered from four starts: all points on one side, all on the other, and cut by the plane in the
    two ways that its heights allow. From each start, points pick their nearer candidates and the body is registered
    again; the smallest error wins.

    Args:
        local: Points of l bodies in their own frames [m], padded.
        weight: 0 for padding.
        candidates: The two positions of each point [m].
        misfit: Mean squared error of the distances at each candidate [m^2].
        reference: The body whose side others take when both sides fit them alike.
        config: See SideConfig.
    """
    config = config or SideConfig()
    cut = _cut(local, weight, (candidates[:, 0] - candidates[:, 1]).norm(dim=-1) / 2, config)
    starts = (torch.zeros_like(cut), torch.ones_like(cut), cut, ~cut)
    results = [_settle(local, weight, candidates, misfit, start, config) for start in starts]
    picks, errors = torch.stack([r[0] for r in results], 1), torch.stack([r[1] for r in results], 1)
    mostly_second = (picks * weight).sum(-1) > 0.5 * weight.sum(-1)
    best = errors[..., reference].argmin(1)
    side = mostly_second[..., reference].gather(1, best[:, None])
    agrees = mostly_second == side[..., None]
    best = torch.where(agrees, errors * config.reference_margin, errors).argmin(1)
    return picks.gather(1, best[:, None, :, None].expand(-1, 1, -1, picks.shape[-1]))[:, 0]


def _cut(
    local: Float[Tensor, "l p 3"], weight: Float[Tensor, "l p"], height: Float[Tensor, "b l p"], config: SideConfig
) -> Bool[Tensor, "b l p"]:
    """Where the plane cuts each body, up to exchanging the sides.

    A point's height over the plane is linear in its own coordinates, h = a . (x, 1). The distances give |h|, so that
    the ten products of a are a linear least-squares fit to h^2, and a is their leading eigenvector.
    """
    count = weight.sum(-1)[:, None, None]
    centred = local - (local * weight[..., None]).sum(1, keepdim=True) / count
    size = ((centred.square() * weight[..., None]).sum((1, 2), keepdim=True) / count).sqrt().clamp(min=1e-6)
    x = torch.cat([centred / size, torch.ones_like(local[..., :1])], -1)
    rows, columns = torch.triu_indices(4, 4, device=local.device)
    products = x[..., rows] * x[..., columns] * (2 - (rows == columns).to(x)) * weight[..., None]
    normal = products.mT @ products + config.ridge * torch.eye(10, dtype=x.dtype, device=x.device)
    squares = (height / size[..., 0]).square() * weight
    fit = torch.linalg.solve(normal, products.mT @ squares[..., None])[..., 0]
    matrix = fit.new_zeros(*fit.shape[:-1], 4, 4)
    matrix[..., rows, columns] = fit
    matrix[..., columns, rows] = fit
    leading = torch.linalg.eigh(matrix)[1][..., -1]
    return (x * leading[..., None, :]).sum(-1) > 0


def _settle(
    local: Float[Tensor, "l p 3"], weight: Float[Tensor, "l p"], candidates: Float[Tensor, "b 2 l p 3"],
    misfit: Float[Tensor, "b 2 l p"], second: Bool[Tensor, "b l p"], config: SideConfig,
) -> tuple[Bool[Tensor, "b l p"], Float[Tensor, "b l"]]:
    """Alternate between picking and registering; the picks, and the mean squared error of each body [m^2]."""
    local = local.expand(len(candidates), -1, -1, -1)
    weight = weight.expand(len(candidates), -1, -1)
    away = misfit
    for _ in range(config.rounds):
        points = torch.where(second[..., None], candidates[:, 1], candidates[:, 0])
        T, _ = register(local, points, weight)
        posed = apply_to_cloud(T, local)
        away = (candidates - posed[:, None]).square().sum(-1) + misfit
        second = away[:, 1] < away[:, 0]
    return second, (away.amin(1) * weight).sum(-1) / weight.sum(-1)
