"""Measures of grasps, with their uncertainty."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.geometry.se3 import roma

NORMAL_95 = 1.959963984540054  # Standard deviations of a normal distribution within which 95 % of it lie


def wilson_interval(success: float, total: float) -> tuple[float, float]:
    """Wilson's 95 % confidence interval of a success rate; [0, 1] without trials."""
    if total == 0:
        return 0.0, 1.0
    rate, weight = success / total, NORMAL_95**2 / total
    middle = rate + weight / 2
    spread = math.sqrt(weight * rate * (1 - rate) + weight**2 / 4)
    return max(0.0, (middle - spread) / (1 + weight)), min(1.0, (middle + spread) / (1 + weight))


def success_rate(success: float, asked: float) -> tuple[float, float, float]:
    """Share of successes among the grasps asked for, and its 95 % interval (Wilson); NaN and [0, 1] if none was asked for."""
    return success / asked if asked else math.nan, *wilson_interval(success, asked)


def difference_interval(before: int, n_before: int, after: int, n_after: int) -> tuple[float, float]:
    """95 % interval of how much a success rate is higher after than before; [-1, 1] without trials on one side.

    Source: Newcombe 1998, Statistics in Medicine 17, method 10: the two Wilson intervals are squared and added. The two rates
    count as independent, which is cautious where they are of the same objects.
    """
    if not (n_before and n_after):
        return -1.0, 1.0
    p, (p_low, p_high) = before / n_before, wilson_interval(before, n_before)
    q, (q_low, q_high) = after / n_after, wilson_interval(after, n_after)
    return q - p - math.hypot(q - q_low, p_high - p), q - p + math.hypot(q_high - q, p - p_low)


def mean_of_rates(rates: Sequence[float], asked: Sequence[int]) -> tuple[float, float, float]:
    """Mean of the success rates of several hands, and its 95 % interval; those of which nothing was asked do not count.

    The mean of k rates of n_i grasps varies as the rate of k^2 / sum(1 / n_i) grasps does, if all have one rate; the interval
    is Wilson's of as many. With one n for all these are all grasps.
    """
    known = [(rate, n) for rate, n in zip(rates, asked, strict=True) if n]
    if not known:
        return success_rate(0, 0)
    total = len(known) ** 2 / sum(1 / n for _, n in known)
    return success_rate(sum(rate for rate, _ in known) / len(known) * total, total)


def mean_share(shares: Float[Tensor, " n"], asked: int | None = None) -> tuple[float, float, float]:
    """Mean of a share that each grasp has, and its 95 % interval; NaN and [0, 1] without grasps.

    The interval is Wilson's for as many successes: shares vary less than successes of the same mean, so it is cautious. Of
    grasps that were asked for and are not there, the share is 0.
    """
    return success_rate(float(shares.double().sum()), len(shares) if asked is None else asked)


def finger_contact(counts: Float[Tensor, " n"] | Int[Tensor, " n"], fingers: int) -> tuple[float, float]:
    """Mean share of a hand's fingers in contact with the object, and share of grasps with all of them; NaN without grasps."""
    return float(counts.float().mean()) / fingers, float((counts == fingers).float().mean())


def diversity(T_object_wrist: Float[Tensor, "n 4 4"], joints: Float[Tensor, "n n_dof"]) -> dict[str, float]:
    """The paper's diversity: the standard deviation of each wrist coordinate and joint over grasps, averaged.

    The wrist coordinates are x, y, z [m] and roll, pitch, yaw [rad]. The mean mixes units, as in the paper, so wrist and
    joints are also given separately. Source: paper section IV-A.
    """
    if len(joints) < 2:
        return {"all": 0.0, "wrist": 0.0, "joints": 0.0}
    angles = torch.stack(list(roma.rotmat_to_euler("xyz", T_object_wrist[:, :3, :3].double(), as_tuple=True)), -1)
    wrist = torch.cat([T_object_wrist[:, :3, 3].double(), angles], -1).std(0)
    fingers = joints.double().std(0)
    return {"all": float(torch.cat([wrist, fingers]).mean()), "wrist": float(wrist.mean()), "joints": float(fingers.mean())}


def roc_area(score: Float[Tensor, " n"], success: Bool[Tensor, " n"]) -> float:
    """Probability that a success scores higher than a failure; ties count half, NaN if all grasps have one outcome.

    This is the Mann-Whitney U statistic as a share of all pairs.
    """
    good, bad = score[success], score[~success].sort().values
    if not len(good) or not len(bad):
        return math.nan
    below, not_above = (torch.searchsorted(bad, good, right=right) for right in (False, True))
    return float((below + not_above).double().mean()) / (2 * len(bad))
