"""The step of a wrist pose that synthesis and refinement share."""

from __future__ import annotations

import roma
from jaxtyping import Float
from torch import Tensor

from dro_grasp.geometry.se3 import compose, rotate


def moved(
    T: Float[Tensor, "n 4 4"], pivot: Float[Tensor, "n 3"], move: Float[Tensor, "n 3"], turn: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 4 4"]:
    """Poses turned about a pivot and then shifted.

    Args:
        T: Poses [m].
        pivot: Point about which each is turned [m].
        move: Shift [m].
        turn: Rotation vector [rad].
    """
    rotation = roma.rotvec_to_rotmat(turn)
    return compose(rotation @ T[:, :3, :3], rotate(rotation, T[:, :3, 3] - pivot) + pivot + move)
