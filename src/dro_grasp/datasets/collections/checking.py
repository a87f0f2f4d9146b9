"""Try stored grasps again: does a data set hold what it says, and what of anybody's grasps passes a protocol?"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from dro_grasp.datasets.collections.collection import PairGrasps
from dro_grasp.errors import GraspFileError, OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.sources import hand_of, object_of, require_same
from dro_grasp.hands.hand import Hand
from dro_grasp.simulation.outcome import kind_of_failure
from dro_grasp.simulation.protocols import Protocol
from dro_grasp.simulation.trial import simulate

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Agreement:
    """Stored verdicts against those of another trial, for some grasps."""

    protocol: str
    """Of the new trial."""
    tried: int = 0
    agreed: int = 0
    """Same verdict as stored."""
    succeeded: int = 0
    """Passed the new trial."""
    reasons: Counter[str] = field(default_factory=Counter)
    """Why stored successes failed now."""
    hands: dict[str, tuple[int, int]] = field(default_factory=dict)
    """By hand: tried, and passed the new trial."""


def check(
    pairs: Iterable[PairGrasps], sample: int, rules: Protocol, seed: int = 0, progress: Progress | None = None
) -> Agreement:
    """Try a random sample of stored grasps again and compare verdicts.

    Args:
        pairs: The data set, failures included if they are to be checked as well.
        sample: How many grasps, drawn evenly from all; all of them if there are fewer.
        rules: The protocol.
        seed: Of the draw.
        progress: Called with (grasps tried, grasps to try).

    Raises:
        OptionError: `sample` is not positive.
        GraspFileError: The data set is empty, or a hand or an object is not the one the grasps were made for.
    """
    if sample < 1:
        raise OptionError(f"sample is {sample}; check at least one grasp")
    parts = [pair for pair in pairs if len(pair.grasps)]
    sizes = [len(pair.grasps) for pair in parts]
    if not parts:
        raise GraspFileError("the data set holds no grasp; there is nothing to check")
    order = torch.randperm(sum(sizes), generator=torch.Generator().manual_seed(seed))
    chosen = torch.zeros(sum(sizes), dtype=torch.bool)
    chosen[order[:sample]] = True
    result, wanted = Agreement(rules.label), int(chosen.sum())
    loaded: dict[str, Hand] = {}
    for pair, mask in zip(parts, chosen.split(sizes), strict=True):
        if mask.any():
            result = _with_pair(result, pair.grasps[mask], rules, loaded)
            if progress is not None:
                progress(result.tried, wanted)
    return result


def keep_passing(
    pairs: Iterable[PairGrasps], rules: Protocol, progress: Progress | None = None
) -> list[tuple[PairGrasps, GraspBatch]]:
    """Try all grasps and keep what passes, with the new trial's numbers: pairs, and what is left of each.

    Raises:
        GraspFileError: A hand or an object is not the one the grasps were made for.
    """
    loaded: dict[str, Hand] = {}
    parts = list(pairs)
    total, done, kept = sum(len(p.grasps) for p in parts), 0, []
    for pair in parts:
        if not len(pair.grasps):
            continue
        tried, passed, _ = _try(pair.grasps, rules, loaded)
        kept.append((pair, tried[passed]))
        done += len(tried)
        if progress is not None:
            progress(done, total)
    return kept


def _with_pair(result: Agreement, grasps: GraspBatch, rules: Protocol, loaded: dict[str, Hand]) -> Agreement:
    _, passed, reasons = _try(grasps, rules, loaded)
    failed = Counter(kind_of_failure(r) for r, was in zip(reasons, grasps.success.tolist(), strict=True) if r and was)
    tried, success = result.hands.get(grasps.hand, (0, 0))
    return replace(
        result, tried=result.tried + len(grasps), agreed=result.agreed + int((passed == grasps.success).sum()),
        succeeded=result.succeeded + int(passed.sum()), reasons=result.reasons + failed,
        hands=result.hands | {grasps.hand: (tried + len(grasps), success + int(passed.sum()))},
    )


def _try(
    grasps: GraspBatch, rules: Protocol, loaded: dict[str, Hand]
) -> tuple[GraspBatch, Bool[Tensor, " n"], tuple[str, ...]]:
    """The grasps with their new results, which of them passed, and why the others did not."""
    if grasps.hand_sha256 not in loaded:
        loaded[grasps.hand_sha256] = hand_of(grasps, None)
    hand, obj = loaded[grasps.hand_sha256], object_of(grasps, None, 1.0)
    require_same(grasps, hand, obj)
    trial = simulate(hand, obj, grasps, rules)
    return grasps.with_trial(trial), trial.success, trial.reason
