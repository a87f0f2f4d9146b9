"""What makes a grasp a label that holds: it comes to rest, squeezes for the object's weight, and passes several protocols."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import RELABELLED
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimize.fingers import close_idle_fingers
from dro_grasp.optimize.grasp_energy import EnergyConfig, GraspEnergy
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.settling import SettleConfig, Settled, settle_all
from dro_grasp.simulation.grasp_state import WeightConfig
from dro_grasp.simulation.outcome import FEWEST_LINKS, TrialResult
from dro_grasp.simulation.protocols import Protocol
from dro_grasp.simulation.trial import simulate_many

RESTLESS = "does not come to rest"
"""Reason that counts grasps which still move the object when the hand closes a second time, and therefore get no trial."""
CHEAP = SettleConfig(weight=WeightConfig(pull=0), payloads=False)
"""Settling as `generate` does it, without pulls and payloads: they only inform a score and those who ask (ours)."""
SETTLED = "settled"
"""What the provenance of a grasp says, after its first entry, when it was settled again."""


def at_rest(
    hand: Hand, objects: Sequence[ObjectModel], batches: Sequence[GraspBatch], close_fingers: bool = False, device: str = "cpu"
) -> list[tuple[GraspBatch, Bool[Tensor, " n"]]]:
    """Grasps where closing leaves them, with a pregrasp and a squeeze for the object's weight, and which come to rest.

    Energies stay those by which a grasp was once chosen; outcomes are dropped. What does not come to rest stays as it is.
    With `close_fingers`, idle fingers first close onto the object. Several objects close together on a device.
    """
    problems, ready = [GraspProblem(hand, obj, device) for obj in objects], list(batches)
    if close_fingers:
        config = EnergyConfig(hand_points=hand.n_points)
        ready = [close_idle_fingers(problem.energy(config), grasps) if len(grasps) else grasps
                 for problem, grasps in zip(problems, batches, strict=True)]
    some = [i for i, grasps in enumerate(batches) if len(grasps)]
    found = settle_all([problems[i] for i in some], [ready[i] for i in some], CHEAP)
    rested = {i: _rested(batches[i], own) for i, own in zip(some, found, strict=True)}
    return [rested.get(i, (grasps, torch.zeros(0, dtype=torch.bool))) for i, grasps in enumerate(batches)]


def _rested(grasps: GraspBatch, found: Settled) -> tuple[GraspBatch, Bool[Tensor, " n"]]:
    """What has settled, in the place of what comes to rest, and which does."""
    stable, posed = found.stable, {}
    for name in ("T_object_wrist", "joints", "pregrasp_joints", "squeeze_joints"):
        old, new = getattr(grasps, name), getattr(found.grasps, name)
        posed[name] = torch.where(stable.reshape(-1, *[1] * (old.ndim - 1)), new, old)
    provenance = tuple(
        f"{text}, {SETTLED}" if rests and not text.endswith(f", {SETTLED}") else text
        for text, rests in zip(grasps.provenance, stable.tolist(), strict=True))
    return grasps.without_trial().replace(**posed, provenance=provenance), stable


def also_passing(
    hand: Hand, objects: Sequence[ObjectModel], batches: Sequence[GraspBatch], protocols: Sequence[Protocol],
    workers: int | None = None, device: str = "cpu",
) -> list[tuple[GraspBatch, Counter[str]]]:
    """Of grasps that passed a first protocol, those that pass further ones too, and how many fail each, by reason.

    What was measured stays that of the first trial; the protocols are all named, and `robustness` is that of the one that
    perturbs. Only what has passed one protocol is tried under the next. A device's verdict is not confirmed here.
    """
    kept, failures = list(batches), [Counter[str]() for _ in batches]
    for rules in protocols:
        trials = simulate_many(hand, objects, kept, rules, workers=workers, device=device, confirm=False)
        for i, (passed, trial) in enumerate(zip(kept, trials, strict=True)):
            failures[i].update(f"{failure.value} under {rules.name}" for failure in trial.failure if failure)
            robustness = torch.where(trial.robustness.isnan(), passed.robustness, trial.robustness)
            labels = tuple(f"{label}, {rules.label}" for label in passed.protocol)
            kept[i] = passed.replace(robustness=robustness, protocol=labels)[trial.success]
    return list(zip(kept, failures, strict=True))


def closed_where_they_hold(
    hand: Hand, objects: Sequence[ObjectModel], batches: Sequence[GraspBatch], protocol: str | Protocol,
    min_links: int = FEWEST_LINKS, workers: int | None = None, device: str = "cpu",
) -> list[GraspBatch]:
    """Grasps after a trial of the protocol; with idle fingers closed where these pass too, no fewer touch, and enough links.

    Column `relabelled` marks them. A device's verdict is not confirmed here. Energies stay those by which grasps were chosen.
    """
    rows, closed = [], []
    for obj, evaluated in zip(objects, batches, strict=True):
        energy = GraspEnergy.of_object(hand, obj, EnergyConfig(hand_points=hand.n_points), device=device)
        own = close_idle_fingers(energy, evaluated) if len(evaluated) else evaluated
        rows.append((own.joints != evaluated.joints).any(1).nonzero()[:, 0])
        closed.append(own.replace(energy=evaluated.energy, extra=evaluated.extra)[rows[-1]])
    trials = simulate_many(hand, objects, closed, protocol, workers=workers, device=device, confirm=False)
    return [_better_of(*each, min_links) for each in zip(batches, rows, closed, trials, strict=True)]


def _better_of(
    evaluated: GraspBatch, rows: Int[Tensor, " k"], closed: GraspBatch, trial: TrialResult, min_links: int
) -> GraspBatch:
    """Evaluated grasps, or in some rows those with closed fingers, where their trial is as good."""
    known = evaluated.extra.get(RELABELLED, [None] * len(evaluated))
    relabelled = torch.tensor([bool(mark) for mark in known], dtype=torch.bool)
    better = trial.success & (trial.contacts >= min_links)
    better &= trial.fingers_in_contact >= evaluated.fingers_in_contact[rows]
    order = torch.arange(len(evaluated))
    order[rows[better]] = len(evaluated) + better.nonzero()[:, 0]
    chosen = GraspBatch.concatenate([evaluated, closed.with_trial(trial)])[order] if len(rows) else evaluated
    return chosen.replace(extra=chosen.extra | {RELABELLED: relabelled | (order >= len(evaluated))})
