"""The losses, as pure functions of tensors."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional


def distance_loss(predicted: Float[Tensor, "b n m"], true: Float[Tensor, "b n m"]) -> Float[Tensor, ""]:
    """Mean absolute error of D(R,O) [m]. Source: paper section III-E."""
    return (predicted - true).abs().mean()


def pose_loss(
    predicted: Float[Tensor, "b l 4 4"], true: Float[Tensor, "b l 4 4"], valid: Bool[Tensor, "*#b #l"]
) -> Float[Tensor, " b"]:
    """Translation error [m] plus rotation error [rad] of each grasp, mean over its valid links.

    Differs from the paper: the angle is computed by atan2 instead of arccos, whose slope is infinite at zero error.
    Source: paper section III-E.
    """
    shift = _norm(predicted[..., :3, 3] - true[..., :3, 3])
    relative = predicted[..., :3, :3].mT @ true[..., :3, :3]
    sine = _norm(torch.stack([
        relative[..., 2, 1] - relative[..., 1, 2], relative[..., 0, 2] - relative[..., 2, 0],
        relative[..., 1, 0] - relative[..., 0, 1],
    ], -1))
    cosine = relative.diagonal(dim1=-2, dim2=-1).sum(-1) - 1
    return _mean(shift + torch.atan2(sine, cosine), valid)


def _mean(values: Float[Tensor, "b n"], valid: Bool[Tensor, "*#b #n"]) -> Float[Tensor, " b"]:
    """Mean of each row over its valid entries, of which it has some."""
    valid = valid.expand_as(values)
    return torch.where(valid, values, 0.0).sum(-1) / valid.sum(-1)


def _norm(x: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """Euclidean norm with a finite slope at zero."""
    return (x.square().sum(-1) + 1e-12).sqrt()


def penetration_loss(
    hand: Float[Tensor, "b n 3"], obj: Float[Tensor, "b m 3"], normals: Float[Tensor, "b m 3"], valid: Bool[Tensor, "*#b #n"]
) -> Float[Tensor, " b"]:
    """Mean penetration of valid hand points into the object [m], by the nearest object point and its outward normal.

    Differs from the paper: a mean instead of a sum, so that the weight does not depend on the number of points.
    Source: paper section III-E.
    """
    with torch.no_grad():
        nearest = torch.cdist(hand, obj).argmin(-1)[..., None].expand(-1, -1, 3)
    signed = ((hand - obj.gather(1, nearest)) * normals.gather(1, nearest)).sum(-1)
    return _mean(functional.relu(-signed), valid)


def divergence(mean: Float[Tensor, "b d"], log_variance: Float[Tensor, "b d"]) -> Float[Tensor, "b d"]:
    """KL divergence of the posterior from N(0, I) [nat], per grasp and latent dimension."""
    return 0.5 * (log_variance.exp() + mean.square() - 1 - log_variance)


def divergence_loss(divergence: Float[Tensor, "b d"], form: Literal["batch_mean", "official"]) -> Float[Tensor, ""]:
    """Sum over latents and mean over the batch, or `official`: the release's, summed over all, then sqrt(1 + x^2) - 1."""
    if form == "official":
        return (1 + divergence.sum().square()).sqrt() - 1
    return divergence.mean(0).sum()


def contrastive_loss(
    features_a: Float[Tensor, "b n c"], features_b: Float[Tensor, "b n c"], points_b: Float[Tensor, "b n 3"],
    temperature: float, sharpness: float,
) -> Float[Tensor, " b"]:
    """Configuration-invariant contrastive loss, mean over points.

    Points with the same index in both clouds attract; others repel, the more the farther apart they are in cloud B.
    Source: paper section III-B; its factor 1/N_l is read as one over the number of points.
    """
    similarity = functional.normalize(features_a, dim=-1) @ functional.normalize(features_b, dim=-1).mT / temperature
    weights = torch.tanh(sharpness * torch.cdist(points_b, points_b))
    weights = weights / weights.amax((1, 2), keepdim=True)
    eye = torch.eye(weights.shape[1], dtype=torch.bool, device=weights.device)
    weights = torch.where(eye, torch.ones_like(weights), weights)
    total = torch.logsumexp(similarity + weights.clamp(min=1e-12).log(), -1)
    return (total - similarity.diagonal(dim1=1, dim2=2)).mean(-1)


def placement_loss(
    log_density: Float[Tensor, " b"], score: Float[Tensor, " b"], other_score: Float[Tensor, " b"]
) -> Float[Tensor, ""]:
    """Negative log density of the true placement, and cross-entropy of true rotations against uniform ones."""
    ranking = functional.softplus(-score) + functional.softplus(other_score)
    return (-log_density + ranking).mean()
