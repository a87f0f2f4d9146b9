"""The network of GenDexGrasp: a conditional variational autoencoder of contact maps. Source: Li et al. 2023, their sizes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lab.methods.point_autoencoder import each, layer

LATENT = 128
"""Numbers in z. Source: GenDexGrasp."""


@dataclass(frozen=True)
class MapOutput:
    """Maps and the distribution of z that they were made from."""

    contact: Float[Tensor, "b m"]
    """Contact of each point, 0 to 1."""
    mean: Float[Tensor, "b latent"]
    log_variance: Float[Tensor, "b latent"]


class ContactMapNetwork(nn.Module):
    """Object points and z in, a contact map out; in training z comes from the true map."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = nn.Sequential(*layer(4, 64), *layer(64, 128), *layer(128, 512))
        self.moments = nn.Linear(512, 2 * LATENT)
        self.local = nn.Sequential(*layer(3, 64), *layer(64, 64))
        self.whole = nn.Sequential(*layer(64, 128), *layer(128, 512))
        # The head's first layer sees local features, global feature and z together; the last two are alike for all points
        # of an object, so they are multiplied once and not once a point.
        self.head_local = nn.Linear(64, 512)
        self.head_shared = nn.Linear(512 + LATENT, 512, bias=False)
        self.head = nn.Sequential(nn.BatchNorm1d(512), nn.ReLU(), *layer(512, 64), *layer(64, 64), nn.Linear(64, 1),
                                  nn.BatchNorm1d(1), nn.Sigmoid())

    def forward(
        self, points: Float[Tensor, "b m 3"], contact: Float[Tensor, "b m"], noise: Float[Tensor, "b latent"]
    ) -> MapOutput:
        """Encode true maps and decode them again.

        Args:
            points: The object about its centre [m].
            contact: Its true map.
            noise: Draws of N(0, 1).
        """
        features = each(self.encoder, torch.cat([points, contact[..., None]], -1)).amax(1)
        mean, log_variance = self.moments(features).chunk(2, -1)
        return MapOutput(self.decode(points, mean + (0.5 * log_variance).exp() * noise), mean, log_variance)

    def decode(self, points: Float[Tensor, "b m 3"], z: Float[Tensor, "b latent"]) -> Float[Tensor, "b m"]:
        """The map that z stands for on each object."""
        local = each(self.local, points)
        whole = each(self.whole, local).amax(1)
        shared = self.head_shared(torch.cat([whole, z], -1))
        return each(self.head, self.head_local(local) + shared[:, None])[..., 0]
