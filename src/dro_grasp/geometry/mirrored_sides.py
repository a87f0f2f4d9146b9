"""Choose the side of a flat object on which each point of a rigid body lies.

Distances to a flat cloud leave two positions for each point, mirrored in its plane. The body's known shape resolves the
ambiguity, because a rigid motion cannot mirror it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.geometry.registration import register
from dro_grasp.geometry.se3 import apply_to_cloud
from dro_grasp.kinds import Checked


@dataclass(frozen=True)
class SideConfig(Checked):
    """Settings of the choice. Values are ours."""

    rounds: int = 4
    """Rounds in which each point picks its nearer candidate and the body is registered again."""
    reference_margin: float = 0.8
    """Factor on the error of a solution on the reference body's side, so that it wins if both sides fit alike."""
    ridge: float = 1e-6
    """Regularises the fit of the heights [1]; lengths are in units of the body's size there."""


@torch.no_grad()
def choose_sides(
    local: Float[Tensor, "l p 3"], weight: Float[Tensor, "l p"], candidates: Float[Tensor, "b 2 l p 3"],
    misfit: Float[Tensor, "b 2 l p"], reference: int, config: SideConfig | None = None,
) -> Bool[Tensor, "b l p"]:
    """Whether each point takes its second candidate.

    Each body is registered from four starts: all points on one side, all on the other, and the two ways in which the
    plane may cut it. From each start, points pick their nearer candidates and the body is registered again; the smallest
    error wins.

    Args:
        local: Points of l bodies in their own frames [m], padded.
        weight: 0 for padding.
        candidates: The two positions of each point [m].
        misfit: Mean squared error of the distances at each candidate [m^2].
        reference: The body whose side the others take if both sides fit alike.
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
    """Side of the plane for each point of each body, up to exchanging the sides.

    A point's height over the plane is linear in its own coordinates, h = a . (x, 1), and the distances give |h|. So
    h^2 = (x, 1)^T (a a^T) (x, 1) is linear in the ten entries of the symmetric matrix a a^T: a least-squares fit gives
    them, and a is the leading eigenvector.
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
    """Alternate between picking and registering; returns the picks and each body's mean squared error [m^2]."""
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
