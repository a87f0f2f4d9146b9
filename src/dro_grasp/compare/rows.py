"""Rows of the benchmark's table: grasps of pairs after their trials, and what is told of them.

Every rate is of the grasps that were asked for: what a method did not return has failed. What is measured on grasps, such as
their fingers in contact, is a mean over those that there are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch

from dro_grasp.compare.metrics import diversity, finger_contact, mean_of_rates, mean_share, roc_area, success_rate
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.grasp_file import SYNTHESIZED
from dro_grasp.simulation.contacts import NAMES
from dro_grasp.simulation.outcome import TrialResult
from dro_grasp.simulation.protocols import Protocol

ALL = "average"  # Name of the row over all hands


@dataclass(frozen=True)
class EvaluatedGrasps:
    """Grasps of one hand on one object, after all trials."""

    grasps: GraspBatch
    results: tuple[TrialResult, ...]  # One for each protocol
    seconds: dict[str, float]  # Time to make one grasp, by part [s]; of grasps that a source returns, with all their candidates
    fingers: int  # Fingers of the hand
    candidates: int  # Grasps that were made, of which these are the best by score

    def best(self, num: int) -> EvaluatedGrasps:
        """The answer to a request for the best `num` by score; the outcome of a trial depends on nothing but the grasp."""
        index = self.grasps.score.topk(min(num, len(self.grasps))).indices
        grasps = self.grasps[index].with_asked(num)
        return replace(self, grasps=grasps, results=tuple(r.rows(index) for r in self.results))


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    grasps: str  # Their source
    stage: str
    hand: str
    asked: int  # Grasps asked for: n, which all rates are of
    returned: int  # Grasps that the method returned, all of which were evaluated
    held: dict[str, int]  # Per protocol how many of them succeeded
    success: dict[str, tuple[float, float, float]]
    """Per protocol the share of successes and its 95 % interval (Wilson); the mean over hands in the row of all."""
    displacement: float
    """Mean displacement of the object over successes of the first protocol, the largest of all forces where each starts anew,
    else the last [m]."""
    rotation: float  # Mean rotation of the object, likewise [rad]
    diversity: float  # The paper's measure over successes of the first protocol, mixing m and rad as the paper does
    trials_held: dict[str, tuple[float, float, float]]
    """Mean share of its trials that a grasp holds in, likewise, per protocol with several trials of each grasp."""
    fingers: dict[str, tuple[float, float]]
    """Per protocol the mean share of the hand's fingers that touch the object after closing, and the share of grasps with
    all of them."""
    ranking: dict[str, float]  # Per protocol the area under the ROC curve of score against success, within each pair
    seconds: dict[str, float]  # Time of one grasp, by part [s]; where a source returns its best, with all their candidates
    candidates: float  # Grasps made for each pair, of which these are the best by score
    optimised: float  # Share of the grasps that an optimiser made, of whatever version
    contact_quality: dict[str, float]  # Means of the analytic metrics of DexGraspBench, if they were measured

    def to_dict(self) -> dict[str, Any]:
        """The row as plain values; `num` is n."""
        return {**asdict(self), "num": self.asked}


def hand_row(source: str, stage: str, parts: Sequence[EvaluatedGrasps], protocols: Sequence[Protocol]) -> Row:
    """One hand's line, of its grasps for each view of each object, which state how many were asked for."""
    success = [torch.cat([t.results[i].success for t in parts]) for i in range(len(protocols))]
    asked, numbers = sum(t.grasps.out_of for t in parts), {}
    held_in, fingers = {}, {}
    for i, rules in enumerate(protocols):
        numbers[rules.label] = int(success[i].sum())
        if rules.perturbations.trials > 1:
            held_in[rules.label] = mean_share(torch.cat([t.results[i].robustness for t in parts]), asked)
        fingers[rules.label] = finger_contact(torch.cat([t.results[i].fingers_in_contact for t in parts]), parts[0].fingers)
    held = GraspBatch.concatenate([t.grasps.replace(extra={}) for t in parts])[success[0]]
    displacement, rotation = (
        torch.cat([values.amax(-1) if protocols[0].reset else values[:, -1] for values in columns])[success[0]]
        for columns in zip(*[(t.results[0].displacement, t.results[0].rotation) for t in parts], strict=True))
    areas = {
        rules.label: _mean([roc_area(t.grasps.score, t.results[i].success) for t in parts])
        for i, rules in enumerate(protocols)
    }
    seconds = {name: _mean([t.seconds[name] for t in parts]) for name in parts[0].seconds}
    return Row(
        source, stage, parts[0].grasps.hand, asked, len(success[0]), numbers,
        {label: success_rate(k, asked) for label, k in numbers.items()},
        displacement=float(displacement.mean()), rotation=float(rotation.mean()),
        diversity=diversity(held.T_object_wrist, held.joints)["all"], trials_held=held_in, fingers=fingers, ranking=areas,
        seconds=seconds, candidates=_mean([t.candidates for t in parts]),
        optimised=_mean([float(SYNTHESIZED.search(maker) is not None) for t in parts for maker in t.grasps.provenance]),
        contact_quality={
            name: _mean([float(x) for t in parts for x in t.grasps.extra[name]])
            for name in NAMES if name in parts[0].grasps.extra
        },
    )


def average(rows: Sequence[Row]) -> Row:
    """The mean over hands, each of which counts alike, however many grasps it was asked for; see `mean_of_rates`."""
    asked = [r.asked for r in rows]
    return replace(
        rows[0], hand=ALL, asked=sum(asked), returned=sum(r.returned for r in rows),
        held={label: sum(r.held[label] for r in rows) for label in rows[0].held},
        success=_average_rates([r.success for r in rows], asked),
        trials_held=_average_rates([r.trials_held for r in rows], asked),
        fingers={
            label: (_mean([r.fingers[label][0] for r in rows]), _mean([r.fingers[label][1] for r in rows]))
            for label in rows[0].fingers
        },
        displacement=_mean([r.displacement for r in rows]), rotation=_mean([r.rotation for r in rows]),
        diversity=_mean([r.diversity for r in rows]),
        ranking={label: _mean([r.ranking[label] for r in rows]) for label in rows[0].ranking},
        seconds={name: _mean([r.seconds[name] for r in rows]) for name in rows[0].seconds},
        candidates=_mean([r.candidates for r in rows]), optimised=_mean([r.optimised for r in rows]),
        contact_quality={name: _mean([r.contact_quality[name] for r in rows]) for name in rows[0].contact_quality},
    )


def _average_rates(
    rates: list[dict[str, tuple[float, float, float]]], asked: Sequence[int]
) -> dict[str, tuple[float, float, float]]:
    """Per protocol the mean over hands and its interval."""
    return {label: mean_of_rates([rate[label][0] for rate in rates], asked) for label in rates[0]}


def _mean(values: Sequence[float]) -> float:
    """The mean of the numbers among them; NaN without any."""
    numbers = [v for v in values if math.isfinite(v)]
    return sum(numbers) / len(numbers) if numbers else math.nan
