"""Positions from distances to known points. Source: paper section III-D, robotic grasp pose point cloud generation."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.devices import at_once, on_accelerator
from dro_grasp.geometry.se3 import apply_to_cloud, register
from dro_grasp.kinds import Checked

THIN = 5e-3  # A cloud is thin if the standard deviation along its thinnest axis is below this [m]. Source: ours


@dataclass(frozen=True)
class MultilaterationConfig(Checked):
    """Settings of the closed form and of the refinement. Values are ours."""

    ridge: float = 1e-8  # added to the anchors' covariance, so that flat clouds stay solvable [m^2]
    thin: float = THIN  # a cloud is thin, and is refined, if the standard deviation along its thinnest axis is below this [m]
    steps: int = 4  # Gauss-Newton steps of the refinement
    damping: float = 1e-4  # added to the Gauss-Newton matrix, per anchor [1]
    max_step: float = 0.05  # longest Gauss-Newton step [m]
    approach_anchors: int = 128
    """All steps but the last two use about so many anchors, evenly from the list: they only approach the minimum."""
    chunk: int | None = None
    """Clouds that are refined at once; None takes what suits the device."""


ON_CPU = 4  # Clouds that are refined at once on a CPU: more do not fit its cache (ours, timed)
COPIES = 6  # Copies of the distances that a step of the refinement needs (ours, counted)
SQUARINGS = 18  # Of a matrix whose leading eigenvector is left: enough for eigenvalues that differ by a ten-thousandth (ours)


@dataclass(frozen=True)
class _Cloud:
    """Anchors about their mean, and how they spread."""

    centre: Float[Tensor, "*b 1 3"]
    points: Float[Tensor, "*b m 3"]
    inverse: Float[Tensor, "*b 3 3"]  # of their covariance and the ridge [1/m^2]
    normal: Float[Tensor, "*b 3"]  # the axis along which they vary the least
    variance: Float[Tensor, "*b"]  # along it [m^2]


def multilaterate(
    distances: Float[Tensor, "*b n m"], anchors: Float[Tensor, "*b m 3"], config: MultilaterationConfig | None = None,
    among: Int[Tensor, " k"] | None = None,
) -> tuple[Float[Tensor, "*b 2 n 3"], Bool[Tensor, "*b"]]:
    """Points whose distances to the anchors are closest to the given ones [m]: both candidates where the anchors are flat.

    The closed form is the minimiser of the linear least-squares problem that is left when the anchors' mean is
    subtracted from the squared distances. If the anchors are thin, a point and its mirror image fit alike: both are
    refined to minima of the sum of (|p - anchor| - distance)^2. They are equal elsewhere; the mask tells which clouds are thin.

    Differs from the paper: its argmin of squared distances to the fourth power is replaced by the linear problem,
    which has one minimum, and on thin clouds by unsquared distances, which weigh noise evenly.

    `among` are rows of a batch of one axis among which all thin clouds are, as `thin_rows` tells: without them a device is
    waited for.
    """
    config = config or MultilaterationConfig()
    cloud = _spread(anchors, config)
    flat = cloud.variance < config.thin**2
    plain = _closed_form(distances, cloud)
    both = torch.stack([plain, plain], -3)
    if bool(flat.any()) if among is None else len(among):
        normal = cloud.normal[..., None, :]
        height = _height(plain, distances, cloud)[..., None] * normal
        # The closed form carries a large error along the thin axis; the height comes from the distances alone.
        level = plain - (plain * normal).sum(-1, keepdim=True) * normal
        start = torch.stack([level + height, level - height], -3)
        both = _refine_where(flat, start, both, distances, cloud, config, among)
    return both + cloud.centre[..., None, :, :], flat


def thin_rows(anchors: Float[Tensor, "b m 3"], room: int) -> Int[Tensor, " k"]:
    """So many rows of a batch, among them those of all thin clouds; all rows where there is not room enough. It waits."""
    config = MultilaterationConfig()
    flat = _spread(anchors, config).variance < config.thin**2
    order = flat.to(torch.uint8).argsort(descending=True, stable=True)
    return order[:room] if int(flat.sum()) <= room else order


def distance_misfit(
    points: Float[Tensor, "*b n 3"], distances: Float[Tensor, "*b n m"], anchors: Float[Tensor, "*b m 3"]
) -> Float[Tensor, "*b n"]:
    """Mean squared difference between a point's distances to the anchors and the given ones [m^2]."""
    centre = anchors.mean(-2, keepdim=True)
    return (_distances(points - centre, anchors - centre) - distances).square().mean(-1)


def _spread(anchors: Float[Tensor, "*b m 3"], config: MultilaterationConfig) -> _Cloud:
    centre = anchors.mean(-2, keepdim=True)
    points = anchors - centre
    with torch.no_grad():
        covariance = points.mT @ points / anchors.shape[-2]
        if on_accelerator(points.device):  # where decompositions wait until it can be read that they succeeded
            ridge = config.ridge * torch.eye(3, dtype=points.dtype, device=points.device)
            inverse = torch.linalg.inv_ex(covariance + ridge).inverse
            normal = leading_eigenvector(inverse)
            variance = (normal * (covariance @ normal[..., None])[..., 0]).sum(-1)
        else:
            variances, axes = torch.linalg.eigh(covariance)
            variances = variances.clamp(min=0)
            inverse = axes @ ((1 / (variances + config.ridge))[..., None] * axes.mT)
            normal, variance = axes[..., 0], variances[..., 0]
    return _Cloud(centre, points, inverse, normal, variance)


def leading_eigenvector(matrix: Float[Tensor, "*b k k"]) -> Float[Tensor, "*b k"]:
    """The unit eigenvector of the largest eigenvalue of a symmetric matrix, by squaring it; no device is waited for.

    Where the two largest agree to a ten-thousandth of the matrix's norm, it is some vector of both.
    """
    norm = torch.linalg.matrix_norm(matrix)[..., None, None]
    # With its norm added, the matrix has no negative eigenvalue, and the largest is the largest in magnitude.
    power = matrix + norm * torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    for _ in range(SQUARINGS):
        power = power / power.abs().amax((-2, -1), keepdim=True)
        power = power @ power
    longest = power.diagonal(dim1=-2, dim2=-1).argmax(-1)[..., None, None].expand(*power.shape[:-1], 1)
    vector = power.gather(-1, longest)[..., 0]
    return vector / vector.norm(dim=-1, keepdim=True)


def _closed_form(distances: Float[Tensor, "*b n m"], cloud: _Cloud) -> Float[Tensor, "*b n 3"]:
    """Linear least squares about the anchors' mean: one 3x3 inverse per cloud, one product for all rows."""
    # With anchors q of zero mean, |p|^2 - 2 q.p = d^2 - |q|^2. Its mean over the anchors removes |p|^2 and leaves 2 q.p =
    # (|q|^2 - d^2) - mean, whose normal matrix is the anchors' covariance.
    q = cloud.points
    weights = q @ cloud.inverse / (2 * q.shape[-2])
    # Subtracting the mean of each row changes nothing in exact arithmetic (the weights sum to zero) and saves digits.
    squared = q.square().sum(-1)[..., None, :] - distances.square()
    return (squared - squared.mean(-1, keepdim=True)) @ weights


def _height(start: Float[Tensor, "*b n 3"], distances: Float[Tensor, "*b n m"], cloud: _Cloud) -> Float[Tensor, "*b n"]:
    """Distance of each point from the anchors' plane, by Pythagoras from its distances and its place in the plane [m]."""
    normal = cloud.normal
    level = start - (start * normal[..., None, :]).sum(-1, keepdim=True) * normal[..., None, :]
    in_plane = level.square().sum(-1) + cloud.points.square().sum(-1).mean(-1)[..., None]
    return (distances.square().mean(-1) - in_plane).clamp(min=1e-6).sqrt()


def _refine_where(
    chosen: Bool[Tensor, "*b"], start: Float[Tensor, "*b 2 n 3"], otherwise: Float[Tensor, "*b 2 n 3"],
    distances: Float[Tensor, "*b n m"], cloud: _Cloud, config: MultilaterationConfig, among: Int[Tensor, " k"] | None,
) -> Float[Tensor, "*b 2 n 3"]:
    """Refine the chosen clouds of the batch, which are some of given rows, from both sides, and leave the others."""
    shape, n, m = start.shape, start.shape[-2], cloud.points.shape[-2]
    rows = chosen.reshape(-1).nonzero()[:, 0] if among is None else among
    start, distances = start.reshape(-1, 2, n, 3), distances.reshape(-1, 1, n, m)
    anchors = cloud.points.reshape(-1, 1, m, 3)
    size = at_once(start.device, ON_CPU, 2 * COPIES * n * m * start.element_size(), config.chunk)
    parts = [_refine(start[part], distances[part], anchors[part], config) for part in rows.split(size)]
    otherwise, found = otherwise.reshape(-1, 2, n, 3), torch.cat(parts)
    if among is not None:
        found = torch.where(chosen[rows, None, None, None], found, otherwise[rows])
    return otherwise.index_put((rows,), found).reshape(shape)


def _refine(
    start: Float[Tensor, "*b n 3"], distances: Float[Tensor, "*#b n m"], anchors: Float[Tensor, "*#b m 3"],
    config: MultilaterationConfig,
) -> Float[Tensor, "*b n 3"]:
    """Gauss-Newton steps; autograd sees the last one alone."""
    # At the minimum, its derivative by the distances is that of the minimum itself (up to second-order terms).
    stride = max(1, anchors.shape[-2] // config.approach_anchors)
    with torch.no_grad():
        points = start
        some_distances, some_anchors = distances[..., ::stride], anchors[..., ::stride, :]
        for _ in range(config.steps - 1):
            points = points + _step(points, some_distances, some_anchors, config)
        points = points + _step(points, distances, anchors, config)
    return points + _step(points, distances, anchors, config)


def _step(
    points: Float[Tensor, "*b n 3"], distances: Float[Tensor, "*#b n m"], anchors: Float[Tensor, "*#b m 3"],
    config: MultilaterationConfig,
) -> Float[Tensor, "*b n 3"]:
    current = _distances(points, anchors)
    with torch.no_grad():
        matrix = _outer_products(points, current.square().reciprocal(), anchors)
        matrix = matrix + config.damping * anchors.shape[-2] * torch.eye(3, dtype=points.dtype, device=points.device)
        inverse = torch.linalg.inv_ex(matrix).inverse  # which does not wait for a GPU; the damping keeps it regular
    pull = 1 - distances / current
    gradient = points * pull.sum(-1, keepdim=True) - pull @ anchors
    step = -(inverse @ gradient[..., None])[..., 0]
    with torch.no_grad():
        scale = (config.max_step / step.norm(dim=-1, keepdim=True).clamp(min=1e-12)).clamp(max=1)
    return step * scale


def _outer_products(
    points: Float[Tensor, "*b n 3"], weights: Float[Tensor, "*b n m"], anchors: Float[Tensor, "*#b m 3"]
) -> Float[Tensor, "*b n 3 3"]:
    """Sum over anchors of weight times (p - a)(p - a)^T, without a tensor of size n x m x 3."""
    squares = (anchors[..., :, None] * anchors[..., None, :]).flatten(-2)
    sums = weights @ torch.cat([anchors, squares], -1)
    cross = points[..., :, None] * sums[..., None, :3]
    own = weights.sum(-1)[..., None, None] * points[..., :, None] * points[..., None, :]
    return own - cross - cross.mT + sums[..., 3:].unflatten(-1, (3, 3))


def _distances(points: Float[Tensor, "*b n 3"], anchors: Float[Tensor, "*#b m 3"]) -> Float[Tensor, "*b n m"]:
    """Distances by one matrix product, for points about the anchors' mean."""
    # Cancellation then costs less than a micrometre beyond 5 mm of distance, and the time is a tenth of cdist's.
    inner = points @ anchors.mT
    squared = points.square().sum(-1)[..., None] + anchors.square().sum(-1)[..., None, :] - 2 * inner
    return squared.clamp(min=1e-10).sqrt()


ROUNDS = 4  # Rounds in which each point picks its nearer candidate and the body is registered again (ours)
REFERENCE_MARGIN = 0.8
"""Factor on the error of a solution on the reference body's side, so that it wins if both sides fit alike (ours)."""
HEIGHT_RIDGE = 1e-6  # Regularises the fit of the heights [1]; lengths are in units of the body's size there (ours)


@torch.no_grad()
def choose_sides(
    local: Float[Tensor, "*#b l p 3"], weight: Float[Tensor, "*#b l p"], candidates: Float[Tensor, "b 2 l p 3"],
    misfit: Float[Tensor, "b 2 l p"], reference: int | Int[Tensor, " b"],
) -> Bool[Tensor, "b l p"]:
    """Whether each point takes its second candidate.

    Distances to a flat cloud leave two positions for each point, mirrored in its plane. The body's known shape resolves the
    ambiguity, because a rigid motion cannot mirror it. Each body is registered from four starts: all points on one side, all on
    the other, and the two ways in which the plane may cut it. From each start, points pick their nearer candidates and the body
    is registered again; the smallest error wins, on the `reference` body's side if both sides fit alike.

    Points of l bodies, the same for all clouds or of each, are in their own frames [m], with weight 0 for padding; misfits at
    their candidates [m^2] are mean squares.
    """
    cut = _cut(local, weight, (candidates[:, 0] - candidates[:, 1]).norm(dim=-1) / 2)
    starts = (torch.zeros_like(cut), torch.ones_like(cut), cut, ~cut)
    weight = weight.expand(len(candidates), -1, -1)[:, None]
    local = local.expand(len(candidates), -1, -1, -1)
    picks, errors = _settle(local, weight, candidates, misfit, torch.stack(starts, 1))
    mostly_second = (picks * weight).sum(-1) > 0.5 * weight.sum(-1)
    reference = torch.as_tensor(reference, device=errors.device).expand(len(errors))[:, None, None].expand(-1, len(starts), 1)
    best = errors.gather(2, reference)[..., 0].argmin(1)
    side = mostly_second.gather(2, reference)[..., 0].gather(1, best[:, None])
    agrees = mostly_second == side[..., None]
    best = torch.where(agrees, errors * REFERENCE_MARGIN, errors).argmin(1)
    return picks.gather(1, best[:, None, :, None].expand(-1, 1, -1, picks.shape[-1]))[:, 0]


def _cut(
    local: Float[Tensor, "*#b l p 3"], weight: Float[Tensor, "*#b l p"], height: Float[Tensor, "b l p"]
) -> Bool[Tensor, "b l p"]:
    """Side of the plane for each point of each body, up to exchanging the sides."""
    # A point's height over the plane is linear in its own coordinates, h = a . (x, 1), and the distances give |h|. So h^2 = (x,
    # 1)^T (a a^T) (x, 1) is linear in the ten entries of the symmetric matrix a a^T: a least-squares fit gives them, and a is
    # the leading eigenvector.
    count = weight.sum(-1)[..., None, None]
    centred = local - (local * weight[..., None]).sum(-2, keepdim=True) / count
    size = ((centred.square() * weight[..., None]).sum((-2, -1), keepdim=True) / count).sqrt().clamp(min=1e-6)
    x = torch.cat([centred / size, torch.ones_like(local[..., :1])], -1)
    rows, columns = torch.triu_indices(4, 4, device=local.device)
    products = x[..., rows] * x[..., columns] * (2 - (rows == columns).to(x)) * weight[..., None]
    normal = products.mT @ products + HEIGHT_RIDGE * torch.eye(10, dtype=x.dtype, device=x.device)
    squares = (height / size[..., 0]).square() * weight
    fit = torch.linalg.solve_ex(normal, products.mT @ squares[..., None]).result[..., 0]  # without waiting for its success
    matrix = fit.new_zeros(*fit.shape[:-1], 4, 4)
    matrix[..., rows, columns] = fit
    matrix[..., columns, rows] = fit
    leading = leading_eigenvector(matrix) if on_accelerator(matrix.device) else torch.linalg.eigh(matrix)[1][..., -1]
    return (x * leading[..., None, :]).sum(-1) > 0


def _settle(
    local: Float[Tensor, "b l p 3"], weight: Float[Tensor, "b 1 l p"], candidates: Float[Tensor, "b 2 l p 3"],
    misfit: Float[Tensor, "b 2 l p"], second: Bool[Tensor, "b s l p"],
) -> tuple[Bool[Tensor, "b s l p"], Float[Tensor, "b s l"]]:
    """Alternate between picking and registering from each start; returns the picks and each body's mean squared error [m^2]."""
    local, weight = local[:, None].expand(*second.shape, 3), weight.expand(second.shape)
    away = misfit[:, None]
    for _ in range(ROUNDS):
        points = torch.where(second[..., None], candidates[:, None, 1], candidates[:, None, 0])
        T, _ = register(local, points, weight)
        posed = apply_to_cloud(T, local)
        away = (candidates[:, None] - posed[:, :, None]).square().sum(-1) + misfit[:, None]
        second = away[:, :, 1] < away[:, :, 0]
    return second, (away.amin(2) * weight).sum(-1) / weight.sum(-1)
