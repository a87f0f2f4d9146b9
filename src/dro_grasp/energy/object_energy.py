"""The grasp energy on any object, and of grasps without chosen contacts."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dro_grasp.energy.contact_candidates import ContactConfig
from dro_grasp.energy.grasp_energy import EnergyConfig, Evaluation, GraspEnergy
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel


def object_energy(
    hand: Hand, obj: ObjectModel, config: EnergyConfig | None = None, contacts: ContactConfig | None = None,
    device: torch.device | str = "cpu",
) -> GraspEnergy:
    """The energy on the object's grid of signed distances."""
    surface = torch.as_tensor(obj.cloud, dtype=torch.float32)
    centre = torch.as_tensor(obj.centre_of_mass, dtype=torch.float32)
    length = float((surface - centre).norm(dim=-1).mean())
    return GraspEnergy(hand, obj.distance_field, centre, length, config, contacts, device)


def evaluate_nearest(energy: GraspEnergy, T_object_wrist: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"]) -> Evaluation:
    """The energy with the contact of each slot at that slot's candidate nearest to the surface."""
    return energy(T_object_wrist, q, nearest_contacts(energy, T_object_wrist, q))


def nearest_contacts(
    energy: GraspEnergy, T_object_wrist: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], reach: float = math.inf
) -> Int[Tensor, "n c"]:
    """The candidate of each slot that is nearest to the surface; slots do not share a candidate.

    A slot without a candidate within `reach` [m] takes one from the slot that is nearest to the surface.
    """
    candidates = energy.candidates
    poses = T_object_wrist[:, None] @ energy.hand.tree.forward(q)
    distance = energy.field.distances(energy.contact_points.place(poses))[0].abs()
    taken = torch.zeros_like(distance)
    allowed = candidates.slot_weights > 0
    nearest = torch.where(allowed, distance[:, None], torch.inf).amin(-1)
    chosen = []
    for slot in range(len(allowed)):
        own = allowed[slot].expand(len(T_object_wrist), -1)
        own = torch.where(nearest[:, slot, None] > reach, allowed[nearest.argmin(-1)], own)
        index = (distance + taken + torch.where(own, 0.0, torch.inf)).argmin(-1, keepdim=True)
        taken = taken.scatter(-1, index, 1.0)
        chosen.append(index)
    return torch.cat(chosen, -1)
