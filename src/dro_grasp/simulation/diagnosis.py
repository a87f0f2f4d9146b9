"""Why grasps failed their trials, counted, and what a user can do next."""

from __future__ import annotations

from collections import Counter

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import FAILURE
from dro_grasp.simulation.outcome import Failure

FEW = 0.5
"""Share of successes below which a user is told what to do next (ours)."""
MORE = "propose more candidates for each grasp (--candidates 16), or take them from the optimiser (--method optimise)"
"""What helps against most failures: choosing from more grasps."""
REMEDIES = {
    Failure.PENETRATION: MORE,
    Failure.SELF_PENETRATION: f"see what the hand's shapes do in `dro-grasp hand check HAND --picture hand.png`; {MORE}",
    Failure.UNSTABLE: "see what `dro-grasp hand check HAND` warns of: masses, inertias and limits of the description",
    Failure.PUSHED_AWAY: f"{MORE}; ask for another palm direction (--direction X Y Z), from which the fingers close around it",
    Failure.NO_CONTACT: "check that the object's size suits the hand (--scale), and look at the grasps (`dro-grasp view`)",
    Failure.LOST: MORE,
    Failure.TURNED: MORE,
    Failure.SLIPPED: MORE,
}
"""What to try, by the kind of failure that is most frequent (ours)."""


def count_failures(grasps: GraspBatch) -> dict[str, int]:
    """How many evaluated grasps failed for each reason, in words without numbers, the most frequent first."""
    return {kind.value: count for kind, count in _failures(grasps).most_common()}


def diagnose(grasps: GraspBatch) -> list[str]:
    """Lines for people: the count of each reason, and what to try next if few of the evaluated grasps held."""
    failures = _failures(grasps)
    lines = [f"  {count} failed: {kind.value}" for kind, count in failures.most_common()]
    return [*lines, *(f"  next: {step}" for step in next_steps(grasps))]


def next_steps(grasps: GraspBatch) -> list[str]:
    """What to try where fewer than FEW of the evaluated grasps held: the remedies of the two most frequent failures."""
    failures, evaluated = _failures(grasps), int(grasps.evaluated.sum())
    if int(grasps.trial_success.sum()) >= FEW * evaluated:
        return []
    return list(dict.fromkeys(REMEDIES[kind] for kind, _ in failures.most_common(2)))


def _failures(grasps: GraspBatch) -> Counter[Failure]:
    return Counter(Failure[name] for name in grasps.extra.get(FAILURE, ()) if name in Failure.__members__)
