"""Points fixed to a hand's links, placed all at once."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class LinkPoints:
    """Points fixed to links, laid out so that one matrix product places them all.

    The poses of a grasp, as one row of 4 n_links entries for each of x, y and z, times the layout give the coordinates of all
    points: each point's column holds its homogeneous coordinates in the four rows of its own link, and zeros elsewhere.
    """

    layout: Float[Tensor, "rows p"]
    """The columns; rows is 4 n_links [m]."""
    members: Float[Tensor, "p n_links"]
    """One-hot link of each point."""

    @staticmethod
    def of(local: Float[Tensor, "p 3"], links: Int[Tensor, " p"], n_links: int) -> LinkPoints:
        """Lay out points given in their links' frames."""
        members = torch.eye(n_links, dtype=local.dtype, device=local.device)[links]
        homogeneous = torch.cat([local, torch.ones_like(local[:, :1])], -1)
        layout = (members[:, :, None] * homogeneous[:, None, :]).flatten(1).T.contiguous()
        return LinkPoints(layout, members)

    def place(self, poses: Float[Tensor, "n n_links 4 4"]) -> Float[Tensor, "n p 3"]:
        """The points in the world [m]."""
        rows = poses[:, :, :3].transpose(1, 2).reshape(3 * len(poses), -1)
        return (rows @ self.layout).unflatten(0, (-1, 3)).mT
