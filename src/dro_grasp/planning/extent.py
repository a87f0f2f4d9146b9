"""How far from its root a tree of links can get, whatever its joints: bounds by the triangle inequality, without a search."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float

from dro_grasp.descriptions.loader import Description
from dro_grasp.kinematics.tree import PRISMATIC, REVOLUTE, KinematicTree


def farthest(
    tree: KinematicTree, lower: Float[np.ndarray, " n_dof"], upper: Float[np.ndarray, " n_dof"], link: int,
    points: Float[np.ndarray, "n 3"],
) -> float:
    """No point that is fixed to a link gets farther from the root link's origin than this [m].

    Args:
        tree: The links.
        lower: Least value of each independent joint [rad or m].
        upper: Greatest value of each independent joint [rad or m].
        link: Index of the link.
        points: In the link's frame [m].
    """
    tree = tree.double
    coupling, offset = tree.link_coupling, tree.link_offset
    ends = torch.stack([coupling * torch.from_numpy(end).double() for end in (lower, upper)])
    travel = torch.stack([ends.amin(0).sum(-1), ends.amax(0).sum(-1)]).add(offset).abs().amax(0)
    reach, held = 0.0, torch.from_numpy(points).double()
    while link >= 0:
        turns = tree.kind[link] == REVOLUTE
        centre = tree.anchor[link] if turns else torch.zeros_like(tree.anchor[link])  # a turn keeps distances to this point
        reach += float((held - centre).norm(dim=-1).max()) + (float(travel[link]) if tree.kind[link] == PRISMATIC else 0.0)
        held = (tree.origin[link, :3, :3] @ centre + tree.origin[link, :3, 3])[None]
        link = tree.parent[link]
    return reach + float(held.norm())


def farthest_surface(
    description: Description, lower: Float[np.ndarray, " n_dof"], upper: Float[np.ndarray, " n_dof"]
) -> float:
    """No shape of a description gets farther from its root link's origin than this [m]; limits are as for `farthest`."""
    tree = description.tree
    return max((farthest(tree, lower, upper, shape.link, shape.vertices) for shape in description.geometry), default=0.0)
