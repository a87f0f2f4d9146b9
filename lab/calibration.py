"""Whether confidence is what it says: predicted against observed shares of grasps that hold, and what a least one costs."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.compare.metrics import wilson_interval


def reliability(confidence: Float[Tensor, " n"], held: Bool[Tensor, " n"], bins: int = 10) -> list[dict[str, float]]:
    """What was predicted against what was observed, in bins of confidence of equal width; those without grasps are left out.

    Each bin tells how many grasps it has, their mean confidence, the share that held, and its 95 % interval (Wilson).
    """
    place, found = (confidence.double() * bins).long().clamp(0, bins - 1), []
    for number in range(bins):
        rows = place == number
        n, count = int(rows.sum()), int(held[rows].sum())
        if n:
            low, high = wilson_interval(count, n)
            found.append({"from": number / bins, "to": (number + 1) / bins, "n": n, "predicted": float(confidence[rows].mean()),
                          "observed": count / n, "low": low, "high": high})
    return found


def price_of_least(confidence: Float[Tensor, " n"], held: Bool[Tensor, " n"], least: float) -> dict[str, float]:
    """What a least confidence costs and brings: shares of the grasps that hold and of those that fail that fall below it.

    Also the share that holds, of those below and of the others; NaN of none.
    """
    below = confidence < least
    shares = {"held_lost": below[held], "failing_dropped": below[~held], "hold_below": held[below], "hold_above": held[~below]}
    return {"least": least} | {name: float(rows.double().mean()) for name, rows in shares.items()}
