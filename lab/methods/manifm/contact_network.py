"""The network: a conditional variational autoencoder of contacts, told which hand they are for.

Source: ManiFM (Xu et al. 2024): z of 64 numbers, 128 features of the object, 16 of the hand. Differs from ManiFM: a plain
PointNet stands for PointNet++, and the task's motion and six physical properties are left out: the task is to hold.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lab.methods.manifm.fingertip_contacts import ContactMaps
from lab.methods.point_autoencoder import each, layer

LATENT = 64
"""Numbers in z. Source: ManiFM."""
HAND = 16
"""Features of the hand. Source: ManiFM."""


@dataclass(frozen=True)
class ContactOutput:
    """Predicted contacts and the distribution of z."""

    maps: ContactMaps
    mean: Float[Tensor, "b latent"]
    log_variance: Float[Tensor, "b latent"]


class ContactNetwork(nn.Module):
    """Object points, hand points and z in, contacts out."""

    def __init__(self) -> None:
        super().__init__()
        self.hand = nn.Sequential(*layer(6, 32), *layer(32, HAND))
        self.encoder = nn.Sequential(*layer(10, 64), *layer(64, 128))
        self.moments = nn.Linear(128 + HAND, 2 * LATENT)
        self.local = nn.Sequential(*layer(6, 64), *layer(64, 64))
        self.whole = nn.Sequential(*layer(64, 128), *layer(128, 128))
        self.mix_local = nn.Linear(64, 128)
        self.mix_shared = nn.Linear(128 + HAND + LATENT, 128, bias=False)
        self.head = nn.Sequential(nn.BatchNorm1d(128), nn.ReLU(), *layer(128, 64), nn.Linear(64, 4))

    def forward(
        self, obj: Float[Tensor, "b m 6"], hand: Float[Tensor, "b n 6"], true: ContactMaps, noise: Float[Tensor, "b latent"]
    ) -> ContactOutput:
        """Encode true contacts and decode them again.

        Args:
            obj: Points about the object's centre [m] with normals.
            hand: Points of the open hand in its palm's axes [m] with normals.
            true: True contacts.
            noise: Draws of N(0, 1).
        """
        features = each(self.encoder, torch.cat([obj, true.heat[..., None], true.force], -1)).amax(1)
        told = each(self.hand, hand).amax(1)
        mean, log_variance = self.moments(torch.cat([features, told], -1)).chunk(2, -1)
        return ContactOutput(self._decode(obj, told, mean + (0.5 * log_variance).exp() * noise), mean, log_variance)

    def decode(self, obj: Float[Tensor, "b m 6"], hand: Float[Tensor, "b n 6"], z: Float[Tensor, "b latent"]) -> ContactMaps:
        """The contacts that z stands for."""
        return self._decode(obj, each(self.hand, hand).amax(1), z)

    def _decode(self, obj: Float[Tensor, "b m 6"], told: Float[Tensor, "b h"], z: Float[Tensor, "b latent"]) -> ContactMaps:
        local = each(self.local, obj)
        shared = self.mix_shared(torch.cat([each(self.whole, local).amax(1), told, z], -1))
        values = each(self.head, self.mix_local(local) + shared[:, None])
        return ContactMaps(values[..., 0].sigmoid(), values[..., 1:])
