"""How well the hand encoder matches points: of one hand in two poses, and of two hands.

Source: paper section IV-D and its colour-matching figure; the mean rank is the authors' measure of pretraining.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from dro_grasp.hands.hand import Hand
from dro_grasp.models.encoder import StaticGraphEncoder
from dro_grasp.training.samples import SampleSource

SAMPLES = 32
"""Grasping hands that ranks are averaged over."""


@torch.no_grad()
def matching_rank(
    encoder: StaticGraphEncoder, source: SampleSource, generator: torch.Generator, samples: int = SAMPLES
) -> dict[str, float]:
    """Mean rank of the true match of each point, by hand.

    For each point of a grasping hand, the points of the open hand are ranked by cosine similarity of their features. Rank 1
    is perfect; half the number of points is chance.
    """
    return {name: _rank(*_features(encoder, source, name, name, generator, samples),
                        torch.arange(source.network.n_hand)) for name in source.names}


@torch.no_grad()
def matching_rank_between(
    encoder: StaticGraphEncoder, source: SampleSource, a: str, b: str, generator: torch.Generator, samples: int = SAMPLES
) -> float:
    """Mean rank between a grasping hand a and another, open hand b; `counterparts` gives the true matches."""
    index = counterparts(source.hands[a], source.hands[b])
    return _rank(*_features(encoder, source, a, b, generator, samples), index)


def counterparts(a: Hand, b: Hand) -> Int[Tensor, " n_a"]:
    """For each point of one open hand, the point of another open hand in the same place.

    Points are compared in the palm's axes about the grasp centre, after both hands are scaled to one size. One hand is
    mirrored if that fits better, so that a left hand matches a right one.
    """
    ours, theirs = _normalized(a), _normalized(b)
    mirrored = ours * ours.new_tensor([1, -1, 1])
    distances = [torch.cdist(cloud, theirs) for cloud in (ours, mirrored)]
    best = min(distances, key=lambda d: float(d.amin(1).mean() + d.amin(0).mean()))
    return best.argmin(1)


@torch.no_grad()
def most_similar(
    encoder: StaticGraphEncoder, points: Float[Tensor, "n 3"], reference: Float[Tensor, "m 3"]
) -> Int[Tensor, " n"]:
    """For each point of a hand, the point of a reference hand with the most similar feature; both in the network's axes."""
    features = [functional.normalize(encoder((c - c.mean(0))[None])[0], dim=-1) for c in (points, reference)]
    return (features[0] @ features[1].mT).argmax(1)


def _normalized(hand: Hand) -> Float[Tensor, "n 3"]:
    """The open hand's points in the palm's axes about the grasp centre, scaled to a root mean square of 1."""
    points = (hand.points(hand.canonical_joints()) - hand.grasp_centre_wrist) @ hand.palm_axes_wrist
    return points / points.square().sum(-1).mean().sqrt()


def _features(
    encoder: StaticGraphEncoder, source: SampleSource, a: str, b: str, generator: torch.Generator, samples: int
) -> tuple[Float[Tensor, "s n c"], Float[Tensor, "s n c"]]:
    """Unit features of hand a in stored grasps, and of hand b opened."""
    grasps = source.grasps[a]
    chosen = torch.randint(len(grasps.joints), (samples,), generator=generator, device=generator.device)
    closed = source.hands[a].points(grasps.joints[chosen]) @ source.network.axes(source.hands[a].palm_axes_wrist)
    opened = source.hands[b].points(source.hands[b].random_open_joints(samples, generator))
    opened = opened @ source.network.axes(source.hands[b].palm_axes_wrist)
    first, second = (functional.normalize(encoder(c - c.mean(1, keepdim=True)), dim=-1) for c in (closed, opened))
    return first, second


def _rank(a: Float[Tensor, "s n c"], b: Float[Tensor, "s m c"], index: Int[Tensor, " n"]) -> float:
    """Mean rank of b's indexed points among all points of b, by similarity to each point of a."""
    similarity = a @ b.mT
    own = similarity.gather(2, index.to(a.device).expand(len(a), -1)[..., None])
    return float((similarity > own).sum(-1).float().mean() + 1)
