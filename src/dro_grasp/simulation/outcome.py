"""What became of tried grasps: numbers, verdicts, and the reason of each failure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.simulation.contacts import Penetration
from dro_grasp.simulation.protocols import Protocol

DIRECTIONS = ("+x", "+y", "+z", "-x", "-y", "-z")
"""Order of the forces, in the object's frame."""
GIVE_UP = 0.1
"""An object this far from where the hand had it will not come back [m]."""


@dataclass(frozen=True)
class TrialResult:
    """What became of n grasps. Numbers that a trial never came to measure are NaN."""

    success: Bool[Tensor, " n"]
    displacement: Float[Tensor, "n 6"]
    """Of the object's centre of mass after each force, from where it was after closing [m]; a lost object keeps
    its last value."""
    rotation: Float[Tensor, "n 6"]
    """Of the object after each force, from how it was after closing [rad]; likewise."""
    closing_shift: Float[Tensor, " n"]
    """Displacement of the object while the hand closed [m]."""
    closing_rotation: Float[Tensor, " n"]
    """Rotation of the object while the hand closed [rad]."""
    contact_links: tuple[tuple[str, ...], ...]
    """Names of the hand's links that touch the object after closing."""
    penetration: Float[Tensor, " n"]
    """Deepest penetration of hand and object in the grasp as labelled [m]."""
    self_penetration: Float[Tensor, " n"]
    """Summed penetration of hand links in the grasp as labelled [m]."""
    reason: tuple[str, ...]
    """Why a grasp failed; empty for a success."""
    protocol: str
    """Name and version."""

    @property
    def contacts(self) -> Int[Tensor, " n"]:
        """Number of contact_links."""
        return torch.tensor([len(links) for links in self.contact_links], dtype=torch.int64)

    @property
    def success_rate(self) -> float:
        """Share of successes; NaN without grasps."""
        return float(self.success.float().mean())

    def fill(self, grasps: GraspBatch) -> GraspBatch:
        """The tried grasps with their outcome, and the columns `reason` and `contact_links`."""
        columns = {"reason": list(self.reason), "contact_links": [list(links) for links in self.contact_links]}
        return grasps.with_trial(self).replace(extra=grasps.extra | columns)

    def rows(self, index: Int[Tensor, " k"]) -> TrialResult:
        """The outcome of some of the grasps."""
        kept = index.tolist()
        return replace(
            self, **{name: getattr(self, name)[index] for name in NUMBERS}, reason=tuple(self.reason[i] for i in kept),
            contact_links=tuple(self.contact_links[i] for i in kept))

    @staticmethod
    def join(results: Sequence[TrialResult], label: str) -> TrialResult:
        """One result after the other, all of the same protocol."""
        def column(name: str) -> Tensor:
            return torch.cat([getattr(r, name) for r in results])

        if not results:
            none = np.zeros(0)
            empty = Measured(Penetration(none, none), none, none, (), none > 0, np.zeros((0, 6)), np.zeros((0, 6)))
            return empty.result((), label)
        return TrialResult(
            **{name: column(name) for name in NUMBERS}, reason=tuple(x for r in results for x in r.reason),
            contact_links=tuple(x for r in results for x in r.contact_links), protocol=label,
        )


NUMBERS = tuple(n for n in TrialResult.__dataclass_fields__ if n not in {"reason", "contact_links", "protocol"})
"""Fields of a TrialResult that are tensors."""


def kind_of_failure(reason: str) -> str:
    """A failure's reason without its numbers and directions, for counting."""
    return reason.split(" by ")[0].split(" under ")[0]


@dataclass(frozen=True)
class Measured:
    """Raw measurements of n trials; fields as in TrialResult."""

    penetration: Penetration
    shift: np.ndarray
    turn: np.ndarray
    contacts: tuple[tuple[str, ...], ...]
    stable: np.ndarray
    displacement: np.ndarray
    rotation: np.ndarray

    def judged(self, rules: Protocol) -> TrialResult:
        """Success, or the first reason against it, of every trial."""
        return self.result(tuple(self._reason(i, rules) for i in range(len(self.shift))), rules.label)

    def result(self, reasons: tuple[str, ...], label: str) -> TrialResult:
        """These measurements with their verdicts; those of unstable trials mean nothing and are left out."""
        def tensor(values: np.ndarray, measured: np.ndarray | None = None) -> Tensor:
            kept = values if measured is None else np.where(measured, values.T, np.nan).T
            return torch.from_numpy(np.asarray(kept, np.float32))

        return TrialResult(
            success=torch.tensor([not r for r in reasons], dtype=torch.bool),
            displacement=tensor(self.displacement, self.stable), rotation=tensor(self.rotation, self.stable),
            closing_shift=tensor(self.shift, self.stable), closing_rotation=tensor(self.turn, self.stable),
            contact_links=self.contacts, penetration=tensor(self.penetration.object),
            self_penetration=tensor(self.penetration.own), reason=reasons, protocol=label,
        )

    def _reason(self, i: int, rules: Protocol) -> str:
        lost = np.flatnonzero(self.displacement[i] >= GIVE_UP)
        if self.penetration.object[i] > rules.max_penetration:
            return f"hand penetrates object by {self.penetration.object[i] * 1e3:.0f} mm"
        if self.penetration.own[i] > rules.max_self_penetration:
            return f"hand penetrates itself by {self.penetration.own[i] * 1e3:.0f} mm"
        if not self.stable[i]:
            return "simulation unstable"
        if self.shift[i] > min(rules.max_closing_shift, GIVE_UP) or self.turn[i] > rules.max_closing_rotation:
            return "object pushed away while closing"
        counted = slice(None) if rules.reset else slice(-1, None)
        moved, turned = self.displacement[i, counted].max(), self.rotation[i, counted].max()
        if moved < rules.max_displacement and turned < rules.max_rotation:
            return ""
        if not self.contacts[i]:
            return "no contact after closing"
        if len(lost):
            return f"lost under force {DIRECTIONS[lost[0]]}"
        if moved < rules.max_displacement:
            return f"turned by {np.degrees(turned):.0f} degrees"
        return f"slipped by {moved * 1e3:.0f} mm"
