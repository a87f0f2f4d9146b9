"""Evaluate stored grasps again: do their verdicts hold?"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import torch

from dro_grasp.errors import GraspFileError, OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import require_seed
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.outcome import TrialResult
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, PROTOCOLS, Protocol
from dro_grasp.simulation.trial import simulate
from dro_grasp.training.data.collections.collection import PairGrasps, sound_sources

Progress = Callable[[int, int], None]  # Called with (grasps evaluated, grasps in all)


@dataclass(frozen=True)
class Agreement:
    """Stored verdicts against those of new trials, for some grasps."""

    protocol: str  # of the new trials
    evaluated: int = 0
    agreed: int = 0  # of the trials, those with the stored verdict
    succeeded: int = 0
    reasons: Counter[str] = field(default_factory=Counter)  # why stored successes fail now, counted
    hands: dict[str, tuple[int, int]] = field(default_factory=dict)  # trials and successes by hand

    @property
    def share(self) -> float:
        """Share of the new trials with the stored verdict."""
        return self.agreed / self.evaluated

    def extended(self, grasps: GraspBatch, trial: TrialResult) -> Agreement:
        """With the new trials of more grasps."""
        failed = Counter(f.value for f, held in zip(trial.failure, grasps.trial_success.tolist(), strict=True) if f and held)
        success, agreed = int(trial.success.sum()), int((trial.success == grasps.trial_success).sum())
        of_hand = self.hands.get(grasps.hand, (0, 0))
        return replace(
            self, evaluated=self.evaluated + len(grasps), agreed=self.agreed + agreed,
            succeeded=self.succeeded + success, reasons=self.reasons + failed,
            hands=self.hands | {grasps.hand: (of_hand[0] + len(grasps), of_hand[1] + success)},
        )


def stored_protocol(pairs: Iterable[PairGrasps]) -> str:
    """Name of the protocol whose outcomes a data set states; the usual one where it states none.

    Raises:
        OptionError: It states several, or one of which nothing is known but its label.
    """
    labels = sorted({label for pair in pairs for label in pair.grasps.protocol if label})
    known = {rules.label: name for name, rules in PROTOCOLS.items()}
    if len(labels) > 1 or not set(labels) <= set(known):
        raise OptionError(f"the data set states outcomes under {', '.join(labels)}; say which protocol to check: protocol=...")
    return known[labels[0]] if labels else DEFAULT_PROTOCOL


def check(
    pairs: Iterable[PairGrasps], sample: int, rules: Protocol, seed: int = 0, progress: Progress | None = None
) -> Agreement:
    """Evaluate a random sample of stored grasps with a verdict again, all if there are fewer, and compare verdicts."""
    if sample < 1:
        raise OptionError(f"sample is {sample}; check at least one grasp")
    require_seed(seed)
    parts = [pair.grasps[pair.grasps.evaluated] for pair in pairs]
    sizes = [len(grasps) for grasps in parts]
    if not sum(sizes):
        raise GraspFileError("the data set holds no grasp that has had a trial; there is nothing to check. "
                             "`dro-grasp evaluate` tests grasps that had none")
    order = torch.randperm(sum(sizes), generator=torch.Generator().manual_seed(seed))
    chosen = torch.zeros(sum(sizes), dtype=torch.bool)
    chosen[order[:sample]] = True
    drawn = [grasps[mask] for grasps, mask in zip(parts, chosen.split(sizes), strict=True) if mask.any()]
    result = Agreement(rules.label)
    for grasps, (hand, obj) in zip(drawn, _loaded(drawn, progress), strict=True):
        result = result.extended(grasps, simulate(hand, obj, grasps, rules))
    return result


def _loaded(parts: Sequence[GraspBatch], progress: Progress | None) -> Iterator[tuple[Hand, ObjectModel]]:
    total, done = sum(map(len, parts)), 0
    for grasps, pair in zip(parts, sound_sources(parts), strict=True):
        yield pair
        done += len(grasps)
        if progress is not None:
            progress(done, total)
