"""Outcome of trials: measurements, verdicts, why grasps fail, and what a user can do next."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import FAILURE
from dro_grasp.simulation.contacts import Penetration
from dro_grasp.simulation.protocols import Protocol

FORCES = np.concatenate([np.eye(3), -np.eye(3)])  # Directions of the forces, in the object's frame
DIRECTIONS = ("+x", "+y", "+z", "-x", "-y", "-z")  # Their names, in the same order
LOST_DISTANCE = 0.1  # An object that moves this far counts as lost [m]. Ours
FEWEST_LINKS = 2  # Links that must touch the object after closing; with fewer, a success is a cage or luck. Ours


class Failure(Enum):
    """Why a grasp fails its trial; the value is the reason in words, without numbers."""

    PENETRATION = "hand penetrates object"
    SELF_PENETRATION = "hand penetrates itself"
    UNSTABLE = "simulation unstable"
    PUSHED_AWAY = "object pushed away while closing"
    NO_CONTACT = "no contact after closing"
    LOST = "lost"
    TURNED = "turned"
    SLIPPED = "slipped"


@dataclass(frozen=True)
class TrialResult:
    """Outcome of the trials of n grasps. A quantity that a trial did not measure is NaN.

    Under a protocol that perturbs, a grasp has several trials. Measurements and reason are then those of the first one
    with the grasp's verdict.
    """

    success: Bool[Tensor, " n"]
    """Whether each grasp holds."""
    displacement: Float[Tensor, "n 6"]
    """Displacement of the object's centre of mass after each force, relative to its place after closing, or to that in the
    labelled grasp under a protocol that resets it [m]; a lost object keeps its last value."""
    rotation: Float[Tensor, "n 6"]
    """Rotation of the object after each force, likewise [rad]."""
    closing_shift: Float[Tensor, " n"]
    """Displacement of the object while the hand closes [m]."""
    closing_rotation: Float[Tensor, " n"]
    """Rotation of the object while the hand closes [rad]."""
    contact_links: tuple[tuple[str, ...], ...]
    """Names of the links that touch the object after closing."""
    fingers_in_contact: Int[Tensor, " n"]
    """Number of the hand's fingers that touch the object after closing."""
    penetration: Float[Tensor, " n"]
    """Deepest penetration of hand and object in the labelled grasp [m]. What is pierced, then or once the hand is closed, is
    as deep as the finger is long behind it."""
    self_penetration: Float[Tensor, " n"]
    """Summed penetration of hand links in the labelled grasp [m]."""
    failure: tuple[Failure | None, ...]
    """Why each grasp fails; None for a success."""
    reason: tuple[str, ...]
    """The same in words, with the number or the direction; empty for a success."""
    robustness: Float[Tensor, " n"]
    """Share of its trials in which a grasp holds; NaN under a protocol that does not perturb."""
    shown: Int[Tensor, " n"]
    """The trial that was measured; 0 is the protocol's own, without perturbation."""
    protocol: str
    """Name and version of the protocol, as `Protocol.label`."""
    asked: int | None = None
    """How many grasps were asked for, as `GraspBatch.asked`."""

    def __repr__(self) -> str:
        failed = Counter(kind.value for kind in self.failure if kind).most_common()
        told = "".join(f", {count} failed: {reason}" for reason, count in failed)
        return f"TrialResult({int(self.success.sum())} of {self.out_of} hold under {self.protocol}{told})"

    @property
    def out_of(self) -> int:
        """What a success rate is of: the grasps asked for, or, where that is unknown, those that were evaluated."""
        return len(self.success) if self.asked is None else self.asked

    @property
    def contacts(self) -> Int[Tensor, " n"]:
        """Number of contact_links."""
        return torch.tensor([len(links) for links in self.contact_links], dtype=torch.int64)

    @property
    def success_rate(self) -> float:
        """Share of successes among the grasps asked for; NaN without any."""
        return int(self.success.sum()) / self.out_of if self.out_of else math.nan

    def rows(self, index: Int[Tensor, " k"]) -> TrialResult:
        """The outcome of some of the grasps."""
        kept = index.tolist()
        return replace(
            self, asked=None, **{name: getattr(self, name)[index] for name in NUMBERS},
            **{name: tuple(getattr(self, name)[i] for i in kept) for name in TEXTS})

    @staticmethod
    def join(results: Sequence[TrialResult], label: str, asked: int | None = None) -> TrialResult:
        """One result after the other, all of the same protocol."""
        columns: dict[str, Any]
        if not results:
            none, six = torch.zeros(0), torch.zeros(0, len(DIRECTIONS))
            columns = dict.fromkeys(NUMBERS, none) | dict.fromkeys(TEXTS, ())
            columns |= {"success": none > 0, "displacement": six, "rotation": six}
            columns |= {"fingers_in_contact": none.long(), "shown": none.long()}
            return TrialResult(**columns, protocol=label, asked=asked)
        columns = {name: torch.cat([getattr(r, name) for r in results]) for name in NUMBERS}
        columns |= {name: tuple(x for r in results for x in getattr(r, name)) for name in TEXTS}
        return TrialResult(**columns, protocol=label, asked=asked)


def verdict(trials: TrialResult, count: int, needed: int) -> TrialResult:
    """The outcome of grasps from `count` trials of each, of which a success holds in as many as are needed.

    The trials are the first of every grasp, then the second of every grasp, and so on.
    """
    held = trials.success.reshape(count, -1)
    total = held.sum(0)
    shown = (held == (total >= needed)).int().argmax(0)
    result = trials.rows(shown * held.shape[1] + torch.arange(held.shape[1]))
    reason = tuple(f"{why}; held in {k} of {count} trials" if why else "" for why, k in zip(
        result.reason, total.tolist(), strict=True))
    return replace(result, robustness=total / count, shown=shown, reason=reason)


TEXTS = ("contact_links", "failure", "reason")  # Fields of a TrialResult with one entry a grasp that are no tensors
NUMBERS = tuple(n for n in TrialResult.__dataclass_fields__ if n not in {*TEXTS, "protocol", "asked"})
"""Fields of a TrialResult that are tensors."""


@dataclass(frozen=True)
class Measurements:
    """Raw measurements of n trials; fields as in TrialResult."""

    penetration: Penetration
    shift: Float[np.ndarray, " n"]
    turn: Float[np.ndarray, " n"]
    contacts: tuple[tuple[str, ...], ...]
    fingers: Int[Tensor, " n"]
    stable: Bool[np.ndarray, " n"]
    displacement: Float[np.ndarray, "n 6"]
    rotation: Float[np.ndarray, "n 6"]

    def judged(self, rules: Protocol) -> TrialResult:
        """Success, or the first reason against it, of every trial; unstable trials measure nothing: NaN."""
        verdicts = [self._verdict(i, rules) for i in range(len(self.shift))]

        def tensor(values: Float[np.ndarray, "n *k"], measured: bool = False) -> Float[Tensor, "n *k"]:
            kept = np.where(self.stable, values.T, np.nan).T if measured else values
            return torch.from_numpy(np.asarray(kept, np.float32))

        return TrialResult(
            success=torch.tensor([failure is None for failure, _ in verdicts], dtype=torch.bool),
            displacement=tensor(self.displacement, True), rotation=tensor(self.rotation, True),
            closing_shift=tensor(self.shift, True), closing_rotation=tensor(self.turn, True), contact_links=self.contacts,
            fingers_in_contact=self.fingers,
            penetration=tensor(self.penetration.object), self_penetration=tensor(self.penetration.own),
            failure=tuple(failure for failure, _ in verdicts),
            reason=tuple(failure.value + detail if failure else "" for failure, detail in verdicts),
            robustness=torch.full((len(verdicts),), torch.nan), shown=torch.zeros(len(verdicts), dtype=torch.int64),
            protocol=rules.label,
        )

    def _verdict(self, i: int, rules: Protocol) -> tuple[Failure | None, str]:
        """Why trial i fails, None if it does not, and the number or the direction in words."""
        if self.penetration.object[i] > rules.max_penetration:
            return Failure.PENETRATION, f" by {self.penetration.object[i] * 1e3:.0f} mm"
        if self.penetration.own[i] > rules.max_self_penetration:
            return Failure.SELF_PENETRATION, f" by {self.penetration.own[i] * 1e3:.0f} mm"
        if not self.stable[i]:
            return Failure.UNSTABLE, ""
        if self.shift[i] > min(rules.max_closing_shift, LOST_DISTANCE) or self.turn[i] > rules.max_closing_rotation:
            return Failure.PUSHED_AWAY, ""
        # With a reset every force counts, otherwise the last one alone.
        counted = slice(None) if rules.reset else slice(-1, None)
        moved, turned = self.displacement[i, counted].max(), self.rotation[i, counted].max()
        if moved < rules.max_displacement and turned < rules.max_rotation:
            return None, ""
        if not self.contacts[i]:
            return Failure.NO_CONTACT, ""
        lost = np.flatnonzero(self.displacement[i] >= LOST_DISTANCE)
        if len(lost):
            return Failure.LOST, f" under force {DIRECTIONS[lost[0]]}"
        if moved < rules.max_displacement:
            return Failure.TURNED, f" by {np.degrees(turned):.0f} degrees"
        return Failure.SLIPPED, f" by {moved * 1e3:.0f} mm"


FEW = 0.5  # Share of successes below which a user is told what to do next (ours)
OR_OPTIMISE = ", or take them from the optimiser (source='optimiser')"  # Part of advice that is of no use where it made them
MORE = f"propose more candidates for each grasp (candidates=16){OR_OPTIMISE}"
"""What helps against most failures: choosing from more grasps."""
REMEDIES = {
    Failure.PENETRATION: MORE,
    Failure.SELF_PENETRATION: f"see what the hand's shapes do in `dro-grasp hand check HAND --picture hand.png`; {MORE}",
    Failure.UNSTABLE: "see what `dro-grasp hand check HAND` warns of: masses, inertias and limits of the description",
    Failure.PUSHED_AWAY: f"{MORE}; ask for another palm direction (direction=(X, Y, Z)), so that the fingers close around it",
    Failure.NO_CONTACT: "check that the object's size suits the hand (scale=...), and look at the grasps (`dro-grasp view`)",
    Failure.LOST: MORE,
    Failure.TURNED: MORE,
    Failure.SLIPPED: MORE,
}
"""What to try, by the kind of failure that is most frequent (ours)."""


def count_failures(grasps: GraspBatch) -> dict[str, int]:
    """How many evaluated grasps failed for each reason, in words without numbers, the most frequent first."""
    return {kind.value: count for kind, count in _failures(grasps).most_common()}


def diagnose(grasps: GraspBatch, optimised: bool = False) -> list[str]:
    """Lines for people: the count of each reason, and what to try next if few of the evaluated grasps held."""
    failures = _failures(grasps)
    lines = [f"  {count} failed: {kind.value}" for kind, count in failures.most_common()]
    return [*lines, *(f"  next: {step}" for step in next_steps(grasps, optimised))]


def next_steps(grasps: GraspBatch, optimised: bool = False) -> list[str]:
    """What to try where fewer than FEW of the evaluated grasps held: the remedies of the two most frequent failures.

    Not the optimiser, where it is known that all of them are optimised.
    """
    failures, evaluated = _failures(grasps), int(grasps.evaluated.sum())
    if int(grasps.trial_success.sum()) >= FEW * evaluated:
        return []
    steps = dict.fromkeys(REMEDIES[kind] for kind, _ in failures.most_common(2))
    return [step.replace(OR_OPTIMISE, "") if optimised else step for step in steps]


def _failures(grasps: GraspBatch) -> Counter[Failure]:
    return Counter(Failure[name] for name in grasps.extra.get(FAILURE, ()) if name in Failure.__members__)
