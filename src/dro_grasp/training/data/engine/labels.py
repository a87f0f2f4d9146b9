"""What makes a grasp a label that holds: it comes to rest, squeezes for the object's weight, and passes several protocols."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import torch
from jaxtyping import Bool
from torch import Tensor

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimize.fingers import close_idle_fingers
from dro_grasp.optimize.grasp_energy import EnergyConfig
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.settling import SettleConfig, settle_grasps
from dro_grasp.simulation.grasp_state import WeightConfig
from dro_grasp.simulation.protocols import Protocol
from dro_grasp.simulation.trial import simulate

RESTLESS = "does not come to rest"
"""Reason that counts grasps which still move the object when the hand closes a second time, and therefore get no trial."""
CHEAP = SettleConfig(weight=WeightConfig(pull=0))
"""Settling as `generate` does it, without the pulls: they only inform a score (ours)."""
SETTLED = "settled"
"""What the provenance of a grasp says, after its first entry, when it was settled again."""


def at_rest(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, close_fingers: bool = False, device: str = "cpu"
) -> tuple[GraspBatch, Bool[Tensor, " n"]]:
    """Grasps where closing leaves them, with a pregrasp and a squeeze for the object's weight, and which come to rest.

    Energies stay those by which a grasp was once chosen; outcomes are dropped. What does not come to rest stays as it is.
    With `close_fingers`, idle fingers first close onto the object.
    """
    problem = GraspProblem(hand, obj, device)
    ready = grasps
    if close_fingers:
        ready = close_idle_fingers(problem.energy(EnergyConfig(hand_points=hand.n_points)), grasps)
    found = settle_grasps(problem, ready, CHEAP)
    names = ("T_object_wrist", "joints", "pregrasp_joints", "squeeze_joints")
    stable = found.stable
    posed = {}
    for name in names:
        old, new = getattr(grasps, name), getattr(found.grasps, name)
        posed[name] = torch.where(stable.reshape(-1, *[1] * (old.ndim - 1)), new, old)
    provenance = tuple(
        f"{text}, {SETTLED}" if rests and not text.endswith(f", {SETTLED}") else text
        for text, rests in zip(grasps.provenance, stable.tolist(), strict=True))
    return grasps.without_trial().replace(**posed, provenance=provenance), stable


def also_passing(
    hand: Hand, obj: ObjectModel, passed: GraspBatch, protocols: Sequence[Protocol], workers: int | None = None,
    device: str = "cpu",
) -> tuple[GraspBatch, Counter[str]]:
    """Of grasps that passed a first protocol, those that pass further ones too, and how many fail each, by reason.

    What was measured stays that of the first trial; the protocols are all named, and `robustness` is that of the one that
    perturbs. Only what has passed one protocol is tried under the next. A device's verdict is not confirmed here.
    """
    failures: Counter[str] = Counter()
    for rules in protocols:
        trial = simulate(hand, obj, passed, rules, workers=workers, device=device, confirm=False)
        failures.update(f"{failure.value} under {rules.name}" for failure in trial.failure if failure)
        robustness = torch.where(trial.robustness.isnan(), passed.robustness, trial.robustness)
        labels = tuple(f"{label}, {rules.label}" for label in passed.protocol)
        passed = passed.replace(robustness=robustness, protocol=labels)[trial.success]
    return passed, failures
