"""Numbers that say how good grasps are, with their uncertainty."""

from __future__ import annotations

import math

import roma
import torch
from jaxtyping import Bool, Float
from torch import Tensor

CONFIDENCE = 1.959964
"""Standard deviations of a two-sided 95 % interval."""


def wilson_interval(success: int, total: int) -> tuple[float, float]:
    """95 % confidence interval of a success rate. Source: Wilson 1927.

    Args:
        success: Successes.
        total: Trials; with none, the interval is everything.
    """
    if total == 0:
        return 0.0, 1.0
    rate, z2 = success / total, CONFIDENCE**2
    centre = (rate + z2 / (2 * total)) / (1 + z2 / total)
    half = CONFIDENCE / (1 + z2 / total) * math.sqrt(rate * (1 - rate) / total + z2 / (4 * total**2))
    # Rounding may leave the rate itself outside.
    return max(0.0, min(rate, centre - half)), min(1.0, max(rate, centre + half))


def diversity(
    T_object_wrist: Float[Tensor, "n 4 4"], joints: Float[Tensor, "n n_dof"]
) -> dict[str, float]:
    """The paper's diversity: standard deviation of each wrist coordinate and joint over grasps, then the mean.

    The wrist counts as x, y, z [m] and roll, pitch, yaw [rad], which mixes units, as the paper does; the parts are
    given apart too. Source: paper section IV-A.
    """
    if len(joints) < 2:
        return {"all": 0.0, "wrist": 0.0, "joints": 0.0}
    angles = torch.stack(list(roma.rotmat_to_euler("xyz", T_object_wrist[:, :3, :3].double(), as_tuple=True)), -1)
    wrist = torch.cat([T_object_wrist[:, :3, 3].double(), angles], -1).std(0)
    fingers = joints.double().std(0)
    return {"all": float(torch.cat([wrist, fingers]).mean()), "wrist": float(wrist.mean()), "joints": float(fingers.mean())}


def roc_area(score: Float[Tensor, " n"], success: Bool[Tensor, " n"]) -> float:
    """Probability that a success has a higher score than a failure; ties count half, NaN when one kind is missing."""
    good, bad = score[success], score[~success]
    if not len(good) or not len(bad):
        return math.nan
    above = (good[:, None] > bad).double().mean()
    equal = (good[:, None] == bad).double().mean()
    return float(above + 0.5 * equal)
