"""Random grasps of a training bundle, each with points of its object and of its hand."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.errors import BundleError
from dro_grasp.hands.hand import Hand
from dro_grasp.training.data.bundle.training_file import Bundle


@dataclass(frozen=True)
class DrawnGrasps:
    """Grasps of one hand on several objects, about the objects' centres."""

    hand: Hand
    """With the points of `body`."""
    points: Float[Tensor, "b m 3"]
    """Of the objects' surfaces [m]."""
    normals: Float[Tensor, "b m 3"]
    """Outward unit normals there."""
    body: Float[Tensor, "b n 3"]
    """Of the hand's surface in the grasp [m]."""


class BundleDraws:
    """Draws grasps of a bundle's hands, all hands alike."""

    def __init__(self, bundle: Bundle, hand_points: int, device: torch.device | str = "cpu") -> None:
        """Put hands, grasps and objects on the device of the generators that draw from them.

        Raises:
            BundleError: The bundle holds no grasps.
        """
        names = [name for name, grasps in bundle.grasps.items() if len(grasps.joints)]
        if not names:
            raise BundleError("the bundle holds no grasps; synthesize some first")
        self.hands = [bundle.hands[n].with_points(min(hand_points, bundle.hands[n].n_points)).to(device) for n in names]
        self.grasps = [bundle.grasps[n].to(device) for n in names]
        self.points = torch.stack([cloud.points for cloud in bundle.objects.values()]).to(device)
        self.normals = torch.stack([cloud.normals for cloud in bundle.objects.values()]).to(device)
        self.centres = self.points.mean(1)

    def draw(self, count: int, points: int, generator: torch.Generator) -> DrawnGrasps:
        """Grasps of one hand, each with this many points of its object."""
        device = generator.device
        index = int(torch.randint(len(self.hands), (), generator=generator, device=device))
        hand, grasps = self.hands[index], self.grasps[index]
        chosen = torch.randint(len(grasps.joints), (count,), generator=generator, device=device)
        picks = torch.randint(self.points.shape[1], (count, points), generator=generator, device=device)
        of = grasps.object_index[chosen]
        centre = self.centres[of][:, None]
        body = hand.points(grasps.joints[chosen], grasps.T_object_wrist[chosen])
        return DrawnGrasps(hand, self.points[of[:, None], picks] - centre, self.normals[of[:, None], picks], body - centre)
