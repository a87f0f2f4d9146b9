"""How well the hand encoder matches points: of one hand in two poses, and of two hands.

Source: paper section IV-D and its colour-matching figure; the mean rank is the authors' measure of pretraining.
"""

from __future__ import annotations

import torch
from jaxtyping import Int
from torch import Tensor
from torch.nn import functional

from dro_grasp.network.encoder import StaticGraphEncoder
from dro_grasp.train.samples import SampleSource

SAMPLES = 32  # Grasping hands that ranks are averaged over


def matching_rank(
    encoder: StaticGraphEncoder, source: SampleSource, generator: torch.Generator, samples: int = SAMPLES
) -> dict[str, float]:
    """Mean rank of the true match of each point, by hand.

    For each point of a grasping hand, the points of the open hand are ranked by cosine similarity of their features. Rank 1
    is perfect; half the number of points is chance.
    """
    itself = torch.arange(source.network.n_hand)
    return {name: mean_rank(encoder, source, (name, name), itself, generator, samples) for name in source.names}


@torch.no_grad()
def mean_rank(
    encoder: StaticGraphEncoder, source: SampleSource, pair: tuple[str, str], matches: Int[Tensor, " n"],
    generator: torch.Generator, samples: int = SAMPLES,
) -> float:
    """Mean rank between the points of a hand in stored grasps and those of an open hand.

    Args:
        encoder: The hand encoder.
        source: Hands and grasps.
        pair: Names of the grasping and of the open hand; both may be the same.
        matches: True match on the open hand of each point of the grasping hand.
        generator: Source of randomness.
        samples: Grasping hands that the rank is averaged over.
    """
    (a, axes_a), (b, axes_b) = (
        (source.hands[name], source.network.axes(source.hands[name].palm_axes_wrist)) for name in pair)
    joints = source.grasps[pair[0]].joints
    chosen = torch.randint(len(joints), (samples,), generator=generator, device=generator.device)
    clouds = a.points(joints[chosen]) @ axes_a, b.points(b.random_open_joints(samples, generator)) @ axes_b
    first, second = (functional.normalize(encoder(c - c.mean(1, keepdim=True)), dim=-1) for c in clouds)
    similarity = first @ second.mT
    own = similarity.gather(2, matches.to(similarity.device).expand(samples, -1)[..., None])
    return float((similarity > own).sum(-1).float().mean() + 1)
