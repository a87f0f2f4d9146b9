"""Where each link of a grasping hand is nearest to the object."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dro_grasp.energy.grasp_energy import GraspEnergy


@dataclass(frozen=True)
class NearestPoints:
    """For n grasps, the point nearest to the object on each of the l links that have surface points."""

    links: Int[Tensor, " l"]
    """The links."""
    index: Int[Tensor, "n l"]
    """Which of the hand's surface points."""
    points: Float[Tensor, "n l 3"]
    """Where they are, in the object's frame [m]."""
    link_normals: Float[Tensor, "n l 3"]
    """Outward normals of the links there."""
    gap: Float[Tensor, "n l"]
    """Signed distance to the object [m]."""
    object_normals: Float[Tensor, "n l 3"]
    """Outward normals of the object there."""

    @staticmethod
    def of(energy: GraspEnergy, T_object_wrist: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"]) -> NearestPoints:
        """Those of grasps on the energy's device."""
        hand = energy.hand
        points, normals = hand.points_and_normals(q, T_object_wrist)
        distance, gradient = energy.field.distances(points)
        links = hand.link_index.unique()
        # Points of other links are infinitely far away.
        index = torch.stack([
            torch.where(hand.link_index == link, distance, torch.inf).argmin(1) for link in links.tolist()], 1)
        outward = torch.nn.functional.normalize(_at(gradient, index), dim=-1)
        return NearestPoints(links, index, _at(points, index), _at(normals, index), distance.gather(1, index), outward)

    def pick(self, values: Float[Tensor, "n p 3"]) -> Float[Tensor, "n l 3"]:
        """The rows of these points among those of all surface points."""
        return _at(values, self.index)


def _at(values: Float[Tensor, "n p 3"], index: Int[Tensor, "n l"]) -> Float[Tensor, "n l 3"]:
    return values.gather(1, index[..., None].expand(-1, -1, 3))
