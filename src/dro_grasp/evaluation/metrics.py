"""Measures of grasps, with their uncertainty."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.geometry.rotations import roma

NORMAL_95 = 1.959963984540054
"""Standard deviations of a normal distribution within which 95 % of it lie."""


def wilson_interval(success: int, total: int) -> tuple[float, float]:
    """Wilson's 95 % confidence interval of a success rate; [0, 1] without trials."""
    if total == 0:
        return 0.0, 1.0
    rate, weight = success / total, NORMAL_95**2 / total
    middle = rate + weight / 2
    spread = math.sqrt(weight * rate * (1 - rate) + weight**2 / 4)
    return max(0.0, (middle - spread) / (1 + weight)), min(1.0, (middle + spread) / (1 + weight))


def mean_share(shares: Float[Tensor, " n"]) -> tuple[float, float, float]:
    """Mean of a share that each grasp has, and its 95 % interval; NaN and [0, 1] without grasps.

    The interval is Wilson's for as many successes: shares vary less than successes of the same mean, so it is cautious.
    """
    mean, total = float(shares.mean()), len(shares)
    return mean, *wilson_interval(round(mean * total) if total else 0, total)


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
