"""Conditions of a trial that differ from its protocol, and how those of a protocol that perturbs are drawn."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.devices import Rows
from dro_grasp.geometry import se3
from dro_grasp.geometry.se3 import roma
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.simulation.protocols import Perturbations

FACTORS = ("friction", "mass", "gain")  # Conditions that are factors, as in Perturbations

RESOLUTION = 1e-4  # Grasps that agree to this have the same draws [m or rad]. Ours: another machine rounds otherwise


@dataclass(frozen=True)
class Conditions(Rows):
    """What differs from the protocol in n trials; the factors are those of Perturbations."""

    shift: Float[np.ndarray, "n 3"]  # displacement of the object, in its own frame [m]
    turn: Float[np.ndarray, "n 3"]  # rotation vector of the object about its centre of mass, in its own frame [rad]
    friction: Float[np.ndarray, " n"]
    mass: Float[np.ndarray, " n"]
    gain: Float[np.ndarray, " n"]

    def displaced(self, grasps: GraspBatch, centre_of_mass: Float[np.ndarray, "3"]) -> GraspBatch:
        """The grasps with each object moved away from where it is expected; the hand does not know."""
        centre = torch.from_numpy(centre_of_mass)
        rotation = roma.rotvec_to_rotmat(torch.from_numpy(self.turn))
        T = se3.compose(rotation, centre + torch.from_numpy(self.shift) - rotation @ centre)
        moved = se3.invert(T) @ grasps.T_object_wrist.double()
        return grasps.replace(T_object_wrist=moved.to(grasps.T_object_wrist.dtype))


def draw(config: Perturbations, grasps: GraspBatch) -> Conditions:
    """Conditions of all trials but the first: the second trial of every grasp, then the third, and so on."""
    # A grasp's position and joints are the seed of its draws, so they depend neither on its company nor on a file between.
    k = config.trials - 1
    drawn = [_draw(config, k, _generator(p, q)) for p, q in zip(grasps.T_object_wrist[:, :3, 3], grasps.joints, strict=True)]
    columns = {name: np.stack([d[name] for d in drawn], 1) for name in ("shift", "turn", *FACTORS)}
    return Conditions(**{name: column.reshape(-1, *column.shape[2:]) for name, column in columns.items()})


def _generator(position: Float[Tensor, "3"], joints: Float[Tensor, " n_dof"]) -> np.random.Generator:
    content = (torch.cat([position, joints]).double() / RESOLUTION).round().long().numpy().tobytes()
    return np.random.default_rng(int.from_bytes(hashlib.sha256(content).digest()[:16], "big"))


def _draw(config: Perturbations, k: int, generator: np.random.Generator) -> dict[str, Float[np.ndarray, "k *_"]]:
    """Conditions of k trials of one grasp; each factor takes one value from each of k equal parts of its range."""
    drawn = {}
    for name, size in (("shift", config.shift), ("turn", config.turn)):
        direction = generator.normal(size=(k, 3))
        drawn[name] = size * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    for name in FACTORS:
        low, high = getattr(config, name)
        share = (generator.permutation(k) + generator.random(k)) / k
        drawn[name] = low * (high / low) ** share
    return drawn
