"""Links of a hand that penetrate each other, as MuJoCo finds them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
from jaxtyping import Float
from torch import Tensor

from dro_grasp.descriptions.collision import collide

if TYPE_CHECKING:
    from dro_grasp.descriptions.loader import Description


def self_penetration(description: Description, q: Float[Tensor, " n_dof"]) -> dict[tuple[str, str], float]:
    """Depth [m] by the names of each two links that penetrate each other; neighbours in the tree may.

    Args:
        description: The hand.
        q: Independent joints [rad or m].
    """
    model, tree = description.model, description.tree
    data = mujoco.MjData(model)
    angles = (tree.coupling @ q.double().to(tree.coupling) + tree.offset).tolist()
    for name, angle in zip(tree.moving_names, angles, strict=True):
        data.qpos[model.joint(name).qposadr[0]] = angle
    collide(model, data)
    depths: dict[tuple[str, str], float] = {}
    for contact in data.contact:
        first, second = sorted(int(model.geom_bodyid[g]) for g in contact.geom)
        if contact.dist < 0 and first not in (second, int(model.body_parentid[second])):
            pair = model.body(first).name, model.body(second).name
            depths[pair] = max(depths.get(pair, 0.0), -float(contact.dist))
    return depths
