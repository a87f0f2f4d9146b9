"""Whether the hand encoder knows a point again: in another pose of its hand, and on another hand.

Source: paper section IV-D and its colour-matching figure; the rank as a number is its authors' measure of pretraining.
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
"""Closed hands that ranks are averaged over."""


@torch.no_grad()
def matching_rank(
    encoder: StaticGraphEncoder, source: SampleSource, generator: torch.Generator, samples: int = SAMPLES
) -> dict[str, float]:
    """Mean rank, by cosine similarity, of each grasping hand's point's counterpart among the open hand's, by hand.

    One is perfect, half of the number of points is chance.
    """
    return {name: _rank(*_features(encoder, source, name, name, generator, samples),
                        torch.arange(source.network.n_hand)) for name in source.names}


@torch.no_grad()
def matching_rank_between(
    encoder: StaticGraphEncoder, source: SampleSource, a: str, b: str, generator: torch.Generator, samples: int = SAMPLES
) -> float:
    """The same where the open hand is another one, whose counterparts are those of `counterparts`."""
    index = counterparts(source.hands[a], source.hands[b])
    return _rank(*_features(encoder, source, a, b, generator, samples), index)


def counterparts(a: Hand, b: Hand) -> Int[Tensor, " n_a"]:
    """For each point of one hand the point of another at the same place of the open hand.

    Places are compared in the palm's axes about the grasp centre, after both hands are brought to one size; a left hand is
    mirrored to lie on a right one where that fits better.
    """
    ours, theirs = _standardised(a), _standardised(b)
    mirrored = ours * ours.new_tensor([1, -1, 1])
    distances = [torch.cdist(cloud, theirs) for cloud in (ours, mirrored)]
    best = min(distances, key=lambda d: float(d.amin(1).mean() + d.amin(0).mean()))
    return best.argmin(1)


@torch.no_grad()
def most_similar(
    encoder: StaticGraphEncoder, points: Float[Tensor, "n 3"], reference: Float[Tensor, "m 3"]
) -> Int[Tensor, " n"]:
    """For each point of a hand the point of a reference hand with the most similar feature; both in the network's axes."""
    features = [functional.normalize(encoder((c - c.mean(0))[None])[0], dim=-1) for c in (points, reference)]
    return (features[0] @ features[1].mT).argmax(1)


def _standardised(hand: Hand) -> Float[Tensor, "n 3"]:
    """The open hand's points in the palm's axes about the grasp centre, of root mean square one."""
    points = (hand.points(hand.canonical_joints()) - hand.grasp_centre_wrist) @ hand.palm_axes_wrist
    return points / points.square().sum(-1).mean().sqrt()


def _features(
    encoder: StaticGraphEncoder, source: SampleSource, a: str, b: str, generator: torch.Generator, samples: int
) -> tuple[Float[Tensor, "s n c"], Float[Tensor, "s n c"]]:
    """Unit features of one hand in stored grasps, and of another, or the same, opened."""
    grasps = source.grasps[a]
    chosen = torch.randint(len(grasps.joints), (samples,), generator=generator, device=generator.device)
    closed = source.hands[a].points(grasps.joints[chosen]) @ source.network.axes(source.hands[a])
    opened = source.hands[b].points(source.hands[b].random_open_joints(samples, generator))
    opened = opened @ source.network.axes(source.hands[b])
    first, second = (functional.normalize(encoder(c - c.mean(1, keepdim=True)), dim=-1) for c in (closed, opened))
    return first, second


def _rank(a: Float[Tensor, "s n c"], b: Float[Tensor, "s m c"], index: Int[Tensor, " n"]) -> float:
    """Mean rank of b's point with the given index among all of b's, by similarity to each point of a."""
    similarity = a @ b.mT
    own = similarity.gather(2, index.to(a.device).expand(len(a), -1)[..., None])
    return float((similarity > own).sum(-1).float().mean() + 1)
