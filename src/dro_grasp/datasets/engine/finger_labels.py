"""Labels whose fingers hold: stored grasps with their idle fingers closed, where the grasp still passes its trial."""

from __future__ import annotations

import torch

from dro_grasp.energy.grasp_energy import EnergyConfig, GraspEnergy
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import RELABELLED
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimization.fingers import close_idle_fingers
from dro_grasp.simulation.protocols import Protocol
from dro_grasp.simulation.trial import simulate

MIN_CONTACT_LINKS = 2
"""Links that must touch the object after closing; with fewer, a success is a cage or luck (ours)."""


def closed_where_it_holds(
    hand: Hand, obj: ObjectModel, evaluated: GraspBatch, protocol: str | Protocol, min_links: int = MIN_CONTACT_LINKS,
    workers: int | None = None,
) -> GraspBatch:
    """The grasps; with idle fingers closed instead, where these pass, no fewer fingers touch, and enough links.

    Column `relabelled` marks them. Their energies stay those by which the grasp was once chosen.

    Args:
        hand: The hand.
        obj: An object with a mesh.
        evaluated: Grasps of the two, after a trial of the protocol.
        protocol: The trial.
        min_links: Links that must touch the object after closing.
        workers: As `simulate`.
    """
    known = evaluated.extra.get(RELABELLED, [None] * len(evaluated))
    relabelled = torch.tensor([bool(mark) for mark in known], dtype=torch.bool)
    energy = GraspEnergy.of_object(hand, obj, EnergyConfig(hand_points=hand.n_points))
    closed = close_idle_fingers(energy, evaluated).replace(energy=evaluated.energy, extra=evaluated.extra)
    rows = (closed.joints != evaluated.joints).any(1).nonzero()[:, 0]
    if not len(rows):
        return evaluated.replace(extra=evaluated.extra | {RELABELLED: relabelled})
    trial = simulate(hand, obj, closed[rows], protocol, workers=workers)
    better = trial.success & (trial.contacts >= min_links)
    better &= trial.fingers_in_contact >= evaluated.fingers_in_contact[rows]
    order = torch.arange(len(evaluated))
    order[rows[better]] = len(evaluated) + better.nonzero()[:, 0]
    chosen = GraspBatch.concatenate([evaluated, closed[rows].with_trial(trial)])[order]
    relabelled = relabelled | (order >= len(evaluated))
    return chosen.replace(extra=chosen.extra | {RELABELLED: relabelled})
