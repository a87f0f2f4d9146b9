"""One step of the joint solver: a convex problem per grasp, solved for a whole batch at once.

Minimise over d the sum of un-squared norms |r_i + J_i d|, with d inside a box. One reweighting of iteratively reweighted
least squares (IRLS) handles the norms, an active set the box, and each of its passes is one batched Cholesky factorisation.
Source: paper section III-D, joint configurations.

A norm |r| has the curvature (I - u u^T) / |r| with u = r / |r|. IRLS takes I / |r| instead: it never overshoots, but it
converges slowly near an optimum that misses its targets. `sharpness` s in [0, 1] takes (I - s u u^T) / |r|: 0 is IRLS,
1 is Newton's method.

Layout: see joint_solver. Rows of k = 3 t numbers are coordinate-major (x of all t targets, then y, then z), and the
Jacobian is transposed (p unknowns x k).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.devices import Rows
from dro_grasp.kinds import Checked


@dataclass(frozen=True)
class StepConfig(Checked):
    """How precisely one step is solved. Values are ours."""

    active_set_passes: int = 3  # most solves with a corrected active set; they end when the set no longer changes
    norm_floor: float = 3e-4
    """Below this, norms are replaced by parabolas [m]: the weights stay finite and the optimum moves by less than this."""


@dataclass(frozen=True)
class _Quadratic(Rows):
    """d^T H d / 2 + g^T d over the box [lower, upper]."""

    matrix: Float[Tensor, "b p p"]
    gradient: Float[Tensor, "b p"]
    lower: Float[Tensor, "b p"]
    upper: Float[Tensor, "b p"]


def best_step(
    jacobian: Float[Tensor, "b p k"], residual: Float[Tensor, "b k"], lower: Float[Tensor, "b p"], upper: Float[Tensor, "b p"],
    damping: Float[Tensor, " b"], sharpness: Float[Tensor, " b"] | None = None, config: StepConfig | None = None,
) -> Float[Tensor, "b p"]:
    """The step that brings all points closest to their targets, to first order.

    Args:
        jacobian: Transposed derivative of the k coordinates with respect to p unknowns.
        residual: Coordinates minus targets [m].
        lower: Smallest allowed step, at most 0 [rad or m].
        upper: Largest allowed step, at least 0 [rad or m].
        damping: Multiple of the identity that is added to the normal equations [1/m].
        sharpness: Between IRLS (0, the default) and Newton's method (1).
    """
    config = config or StepConfig()
    matrix, gradient = _model(jacobian, residual, sharpness, config)
    matrix.diagonal(dim1=-2, dim2=-1).add_(damping[:, None])
    return _minimum_in_box(_Quadratic(matrix, gradient, lower, upper), config.active_set_passes)


def _model(
    jacobian: Float[Tensor, "b p k"], residual: Float[Tensor, "b k"], sharpness: Float[Tensor, " b"] | None, config: StepConfig
) -> tuple[Float[Tensor, "b p p"], Float[Tensor, "b p"]]:
    """Curvature H and slope g of the sum of norms.

    With weights w_i = 1 / |r_i|, IRLS has H = sum w_i J_i^T J_i. The correction -s w_i (J_i^T u_i)(J_i^T u_i)^T is of rank
    one per target, so it joins the same matrix product as one more column per target.
    """
    norms = point_norms(residual)
    floored = norms.clamp(min=config.norm_floor)
    scale = floored.reciprocal()
    weighted, plain = jacobian * scale.repeat(1, 3)[:, None], jacobian
    gradient = (weighted @ residual[..., None])[..., 0]
    if sharpness is not None:
        # Below the floor the function is a parabola, and IRLS has its exact curvature.
        share = torch.where(norms > config.norm_floor, sharpness[:, None] * scale, 0.0)
        directions = residual / floored.repeat(1, 3)
        x, y, z = (jacobian * directions[:, None]).chunk(3, -1)
        along = x + y + z
        weighted, plain = torch.cat([weighted, -along * share[:, None]], -1), torch.cat([jacobian, along], -1)
    return weighted @ plain.mT, gradient


def point_norms(residual: Float[Tensor, "*b k"]) -> Float[Tensor, "*b t"]:
    """Length of each target's residual [m]."""
    x, y, z = residual.square().chunk(3, -1)
    return (x + y + z).sqrt()


def smoothed_norms(residual: Float[Tensor, "*b k"], floor: float) -> Float[Tensor, "*b t"]:
    """Norms that IRLS with a floor minimises [m]: a parabola below the floor, joined with equal value and slope."""
    norms = point_norms(residual)
    return torch.where(norms > floor, norms, (norms.square() + floor**2) / (2 * floor))


def _minimum_in_box(quadratic: _Quadratic, passes: int) -> Float[Tensor, "b p"]:
    """Minimum of the quadratic in its box, by a primal-dual active set.

    Each unknown is free, held at its lower bound or held at its upper bound. A pass minimises over the free unknowns. Then
    a free unknown beyond a bound is held there, and a held unknown is released if the slope pulls it back inside. Most
    sets settle in two or three passes; passes after the first one see only the rows whose set has changed.
    """
    lower, upper, gradient = quadratic.lower, quadratic.upper, quadratic.gradient
    # Joints that cannot move have equal bounds: they stay at the lower one whatever the slope.
    frozen = lower >= upper
    # First guess: a bound already reached, with the steepest descent pointing out of the box.
    at_lower, at_upper = (lower >= 0) & (gradient > 0) | frozen, (upper <= 0) & (gradient < 0) & ~frozen
    step, at_lower, at_upper, changed = _pass(quadratic, at_lower, at_upper)
    for _ in range(passes - 1):
        rows = changed.nonzero()[:, 0]
        if len(rows) == 0:
            break
        again = _pass(quadratic.rows(rows), at_lower[rows], at_upper[rows])
        step[rows], at_lower[rows], at_upper[rows], changed[rows] = again
    return step.clamp(lower, upper)


def _pass(
    quadratic: _Quadratic, at_lower: Bool[Tensor, "b p"], at_upper: Bool[Tensor, "b p"]
) -> tuple[Float[Tensor, "b p"], Bool[Tensor, "b p"], Bool[Tensor, "b p"], Bool[Tensor, " b"]]:
    """The minimum for an active set, the next active set, and the rows in which the two differ."""
    step = _solve_free(quadratic, at_lower, at_upper)
    slope = (quadratic.matrix @ step[..., None])[..., 0] + quadratic.gradient
    frozen = quadratic.lower >= quadratic.upper
    fixed = at_lower | at_upper
    next_lower = torch.where(fixed, at_lower & (slope > 0), step < quadratic.lower) | frozen
    next_upper = torch.where(fixed, at_upper & (slope < 0), step > quadratic.upper) & ~frozen
    changed = ((next_lower != at_lower) | (next_upper != at_upper)).any(-1)
    return step, next_lower, next_upper, changed


def _solve_free(quadratic: _Quadratic, at_lower: Bool[Tensor, "b p"], at_upper: Bool[Tensor, "b p"]) -> Float[Tensor, "b p"]:
    """Minimum over the free unknowns, with the others at their bounds.

    Rows and columns of held unknowns become those of the identity, so that all problems of the batch keep one size.
    """
    fixed = at_lower | at_upper
    value = torch.where(at_lower, quadratic.lower, torch.where(at_upper, quadratic.upper, 0.0))
    free = (~fixed).to(value.dtype)
    matrix = quadratic.matrix * free[:, :, None] * free[:, None, :]
    matrix.diagonal(dim1=-2, dim2=-1).add_(1 - free)
    right = -(quadratic.gradient + (quadratic.matrix @ value[..., None])[..., 0]) * free
    factor, _ = torch.linalg.cholesky_ex(matrix)
    return torch.cholesky_solve(right[..., None], factor)[..., 0] * free + value
