"""What grasps carry and how hard they squeeze, for files of other programs and in words; what is unknown is left out."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.effort import find_efforts
from dro_grasp.hands.hand import Hand

COARSE = 10.0  # Masses and forces from here on are told without decimals [kg or N] (ours)


def squeeze_efforts(grasps: GraspBatch, hand: Hand | None = None) -> Float[Tensor, "n n_dof"]:
    """Efforts of the independent joints at the squeeze [Nm, N where it slides]; a row of NaN is unknown.

    A positive effort pushes its joint toward larger values. The effort of a joint that others follow moves them all: by virtual
    work it is the sum of their efforts, each times what that joint moves per unit of this one. With a hand, none exceeds what
    the joint exerts at most (`find_efforts`).
    """
    if hand is None:
        return grasps.squeeze_torque
    limit = find_efforts(hand).limit.to(grasps.squeeze_torque)
    return grasps.squeeze_torque.clamp(-limit, limit)


def efforts_of(efforts: Float[Tensor, "n n_dof"], i: int) -> Float[Tensor, " n_dof"] | None:
    """The efforts of one grasp; None if they are unknown."""
    return efforts[i] if bool(efforts[i].isfinite().all()) else None


def known(value: Float[Tensor, ""]) -> float | None:
    """A number; None if it is unknown."""
    return float(value) if bool(value.isfinite()) else None


def forces_in_words(payload: float | None, squeeze_force: float | None) -> str:
    """What one grasp carries [kg], and with what force it squeezes [N]; empty if both are unknown."""
    carried = None if payload is None else f"carries {short(payload)} kg"
    pressed = None if squeeze_force is None else f"squeezes with {short(squeeze_force)} N"
    return ", ".join(filter(None, (carried, pressed)))


def forces_of_all(grasps: GraspBatch) -> str:
    """The same of several grasps, from the least to the most."""
    columns = (("carry", grasps.payload, "kg"), ("squeeze with", grasps.squeeze_force, "N"))
    return ", ".join(f"{verb} {_range(values)} {unit}" for verb, column, unit in columns
                     if len(values := column[column.isfinite()]))


def _range(values: Float[Tensor, " k"]) -> str:
    ends = dict.fromkeys(short(float(end)) for end in (values.min(), values.max()))
    return " to ".join(ends)


def short(value: float) -> str:
    """A mass or force as precise as it is meant [kg or N]."""
    return f"{value:.0f}" if value >= COARSE else f"{value:.2g}"
