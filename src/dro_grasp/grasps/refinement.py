"""Rank grasps, however they were made, by the grasp energy.

Source: the paper's appendix ranks predictions by DexGraspNet's energy and reports the best; the release does not.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.field import CloudField, DistanceField
from dro_grasp.grasps.grasp_energy import EnergyConfig, Evaluation, GraspEnergy, LinkPoints
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel


@dataclass(frozen=True)
class ScoreConfig:
    """How grasps are judged that the optimiser did not make."""

    energy: EnergyConfig = field(default_factory=lambda: EnergyConfig(penetration=30.0))
    """Weights; predictions penetrate more than synthesised grasps, which closing partly repairs."""
    cloud_points: int = 4096
    """Points of a bare cloud that distances are measured to."""
    batch_size: int = 64
    """Grasps judged at once."""


def score_grasps(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, config: ScoreConfig | None = None
) -> Float[Tensor, " n"]:
    """Minus the grasp energy: higher is better, comparable among grasps of one hand and one object.

    Distances are read off the object's grid, or measured to the points and normals of a bare cloud. The contacts are
    taken to be each finger's candidate that is nearest to the surface.

    Args:
        hand: The grasps' hand.
        obj: Their object.
        grasps: Any grasps of the two.
        config: Weights and sizes.
    """
    config = config or ScoreConfig()
    if not len(grasps):
        return torch.zeros(0)
    with torch.no_grad():
        energy = score_energy(hand, obj, config)
        parts = [
            evaluate_nearest(energy, T, q).total
            for T, q in zip(
                grasps.T_object_wrist.split(config.batch_size), grasps.joints.split(config.batch_size), strict=True
            )
        ]
    return -torch.cat(parts).clone()


def score_energy(hand: Hand, obj: ObjectModel, config: ScoreConfig) -> GraspEnergy:
    """The energy that ranks: of the mesh's grid, or of the cloud where there is no mesh."""
    surface = torch.as_tensor(obj.cloud, dtype=torch.float32)
    grid = obj.grid
    if grid is None:
        step = max(1, len(surface) // config.cloud_points)
        normals = torch.as_tensor(obj.cloud_normals, dtype=torch.float32)
        surroundings: DistanceField | CloudField = CloudField.of(surface[::step], normals[::step])
    else:
        surroundings = DistanceField.of(grid)
    centre = torch.as_tensor(obj.centre_of_mass, dtype=torch.float32)
    length = float((surface - centre).norm(dim=-1).mean())
    return GraspEnergy(hand, surroundings, centre, length, config.energy)


def evaluate_nearest(
    energy: GraspEnergy, T_object_wrist: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"]
) -> Evaluation:
    """The energy with each slot's contact at its candidate nearest to the surface."""
    return energy(T_object_wrist, q, nearest_contacts(energy, T_object_wrist, q))


def nearest_contacts(
    energy: GraspEnergy, T_object_wrist: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"]
) -> Int[Tensor, "n c"]:
    """For each slot its candidate nearest to the surface; slots do not share a candidate."""
    candidates = energy.candidates
    poses = T_object_wrist[:, None] @ energy.hand.tree.forward(q)
    points = LinkPoints.of(candidates.points, candidates.links, energy.hand.tree.n_links).place(poses)
    distance = energy.field.distances(points)[0].abs()
    taken = torch.zeros_like(distance)
    chosen = []
    for weights in candidates.slot_weights:
        cost = distance + taken + torch.where(weights > 0, 0.0, torch.inf)
        index = cost.argmin(-1, keepdim=True)
        taken = taken.scatter(-1, index, 1.0)
        chosen.append(index)
    return torch.cat(chosen, -1)
