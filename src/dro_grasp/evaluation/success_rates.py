"""Success rates of a network and of its controls, before and after refinement and ranking.

Source: paper section IV; the stages, the controls and the trials beside the paper's are ours.
"""

from __future__ import annotations

import math
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Int
from torch import Tensor

from dro_grasp.datasets.bundle.training_file import Bundle
from dro_grasp.evaluation.controls import mean_grasp, mean_grasps, palm_facing_starts
from dro_grasp.evaluation.metrics import diversity, finger_contact, mean_share, roc_area, wilson_interval
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.perception.partial_views import View, partial_view
from dro_grasp.pipeline.choice import ChoiceConfig
from dro_grasp.pipeline.problem import GraspProblem
from dro_grasp.pipeline.stages import optimise, refine, scored
from dro_grasp.predictor import GraspPredictor, GraspRequest
from dro_grasp.simulation.outcome import TrialResult
from dro_grasp.simulation.protocols import Protocol
from dro_grasp.simulation.trial import simulate

RAW = "raw"
"""Stage: grasps as they come."""
RANKED = "ranked"
"""Stage: the best quarter of them by score."""
REFINED = "refined"
"""Stage: refined grasps."""
BEST = "refined, ranked"
"""Stage: the best quarter of the refined grasps by score."""
TOP = {f"refined, top {count}": count for count in (5, 1)}
"""Stages that keep the few best refined grasps of a pair by score, and how many."""
STAGES = (RAW, RANKED, REFINED, BEST, *TOP)
"""All stages."""
NETWORK = "network"
"""Source: the network under test."""
MEAN = "mean grasp"
"""Source: the mean of the training grasps at random rotations."""
MEAN_CHOSEN = "mean grasp, chosen"
"""Source: the same, each rotation chosen by geometry as z is."""
START = "unoptimised start"
"""Source: half-closed hands that face the object."""
SYNTHESISED = "synthesised"
"""Source: grasps that the optimiser makes without a network, settled."""
ALL = "average"
"""Name of the row over all hands."""
KEPT = 0.25
"""Share of the grasps of a pair that ranking keeps, before any trial."""


@dataclass(frozen=True)
class BenchmarkConfig:
    """What is measured."""

    num: int = 100
    """Grasps of each hand on each object, before ranking."""
    stages: tuple[str, ...] = STAGES
    """Which of STAGES."""
    protocols: tuple[Protocol, ...] = ()
    """Trials of every grasp."""
    controls: bool = True
    """Whether the controls are measured beside the network."""
    view: View = "whole"
    """What the network, refinement and ranking see of the object; controls see all of it."""
    views: int = 1
    """Views of each object for each hand, with other random numbers and `num` grasps each."""
    seed: int = 0
    """Of all grasps and views; each pair's seeds are derived from it."""
    workers: int | None = None
    """Threads of the trials; all cores by default."""


@dataclass(frozen=True)
class EvaluatedGrasps:
    """Grasps of one hand on one object, after all trials."""

    grasps: GraspBatch
    results: tuple[TrialResult, ...]
    """One for each protocol."""
    seconds: dict[str, float]
    """Time to make one grasp, by part [s]."""
    fingers: int
    """Fingers of the hand."""

    def rows(self, index: Int[Tensor, " k"]) -> EvaluatedGrasps:
        """Some of the grasps; the outcome of a trial depends on nothing but the grasp."""
        return EvaluatedGrasps(self.grasps[index], tuple(r.rows(index) for r in self.results), self.seconds, self.fingers)


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    grasps: str
    """Their source."""
    stage: str
    hand: str
    num: int
    """Grasps evaluated."""
    success: dict[str, tuple[float, float, float]]
    """Per protocol the share of successes and its 95 % interval (Wilson); the mean over hands in the row of all."""
    displacement: float
    """Mean displacement of the object over successes of the first protocol [m]."""
    rotation: float
    """Mean rotation of the object, likewise [rad]."""
    diversity: float
    """The paper's measure over successes of the first protocol, mixing m and rad as the paper does."""
    trials_held: dict[str, tuple[float, float, float]]
    """Mean share of its trials that a grasp holds in, likewise, per protocol with several trials of each grasp."""
    fingers: dict[str, tuple[float, float]]
    """Per protocol the mean share of the hand's fingers that touch the object after closing, and the share of grasps with
    all of them."""
    ranking: dict[str, float]
    """Per protocol the area under the ROC curve of score against success, within each pair."""
    seconds: dict[str, float]
    """Time of one grasp by part [s]."""


def benchmark(
    hands: Sequence[Hand], objects: Sequence[ObjectModel], predictor: GraspPredictor, config: BenchmarkConfig,
    bundle: Bundle | None = None, progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Measure the success rates.

    Args:
        hands: Which hands.
        objects: Which objects, all with meshes.
        predictor: The network under test.
        config: Numbers, stages and protocols.
        bundle: Training data of the mean grasp; hands that are not in it have no such rows.
        progress: Called with (pairs done, pairs in all).
    """
    table: dict[tuple[str, str], list[list[EvaluatedGrasps]]] = {}
    done, pairs = 0, len(hands) * len(objects)
    for hand in hands:
        found: dict[tuple[str, str], list[EvaluatedGrasps]] = {}
        for obj in objects:
            problem = GraspProblem(hand, obj, predictor.device)
            for seed in view_seeds(config, hand, obj):
                for source in _sources(problem, predictor, config, bundle, seed):
                    for stage, evaluated in _stages(source, obj, config):
                        found.setdefault((source.name, stage), []).append(evaluated)
            done += 1
            if progress is not None:
                progress(done, pairs)
        for key, evaluated in found.items():
            table.setdefault(key, []).append(evaluated)
    rows = []
    for (source, stage), per_hand in table.items():
        single = [_row(source, stage, evaluated, config.protocols) for evaluated in per_hand]
        rows += single if len(single) == 1 else [*single, _average(single)]
    return rows


def pair_seed(seed: int, hand: Hand, obj: ObjectModel) -> int:
    """Seed of one pair: with the same z on all objects, grasps of different pairs would not be independent."""
    return seed + zlib.crc32(f"{hand.name} {obj.name}".encode())


def view_seeds(config: BenchmarkConfig, hand: Hand, obj: ObjectModel) -> range:
    """Seeds of a pair's views; the first is the pair's own."""
    first = pair_seed(config.seed, hand, obj)
    return range(first, first + config.views)


@dataclass(frozen=True)
class _Source:
    """Grasps before any stage."""

    name: str
    problem: GraspProblem
    """The hand, and what is seen of the object."""
    grasps: GraspBatch
    seconds: dict[str, float]
    """Time to make one of them, by part [s]."""


def _sources(
    problem: GraspProblem, predictor: GraspPredictor, config: BenchmarkConfig, bundle: Bundle | None, seed: int
) -> Iterator[_Source]:
    """Grasps of the network and of the controls."""
    hand, obj, num = problem.hand, problem.obj, config.num
    visible = problem if config.view == "whole" else GraspProblem(hand, partial_view(obj, config.view, seed), predictor.device)
    made = predictor.run(visible, GraspRequest(num, seed, candidates=1, refine=False, method="network"))
    yield _Source(NETWORK, visible, made.grasps, {k: made.seconds[k] / num for k in ("network", "decode")})
    if not config.controls:
        return
    if bundle is not None and hand.name in bundle.grasps:
        mean = mean_grasp(bundle, hand.name)
        for name, choice in ((MEAN, ChoiceConfig(draws=1)), (MEAN_CHOSEN, ChoiceConfig())):
            yield _Source(name, problem, mean_grasps(problem, mean, num, seed, choice), {})
    yield _Source(START, problem, palm_facing_starts(hand, obj, num, seed), {})
    begin = time.perf_counter()
    yield _Source(SYNTHESISED, problem, optimise(problem, num, seed), {"synthesis": (time.perf_counter() - begin) / num})


def _stages(source: _Source, obj: ObjectModel, config: BenchmarkConfig) -> Iterator[tuple[str, EvaluatedGrasps]]:
    """The stages asked for; what several of them share is made once. Trials see the whole object."""
    asked = set(config.stages)
    problem, grasps, seconds = source.problem, source.grasps, source.seconds
    quarter = max(1, round(KEPT * len(grasps)))
    for whole, best in ((RAW, {RANKED: quarter}), (REFINED, {BEST: quarter, **TOP})):
        wanted = {whole, *best} & asked
        if not wanted:
            continue
        if whole == REFINED:
            begin = time.perf_counter()
            grasps = refine(problem, grasps)
            seconds = seconds | {"refine": (time.perf_counter() - begin) / len(grasps)}
        if grasps.score.isnan().any():
            grasps = scored(problem, grasps)
        results = tuple(simulate(problem.hand, obj, grasps, rules, workers=config.workers) for rules in config.protocols)
        evaluated = EvaluatedGrasps(grasps, results, seconds, len(problem.hand.fingers))
        if whole in wanted:
            yield whole, evaluated
        for stage, count in best.items():
            if stage in wanted:
                yield stage, evaluated.rows(grasps.score.topk(min(count, len(grasps))).indices)


def _row(source: str, stage: str, parts: list[EvaluatedGrasps], protocols: Sequence[Protocol]) -> Row:
    """One hand's line."""
    success = [torch.cat([t.results[i].success for t in parts]) for i in range(len(protocols))]
    rates, held_in, fingers = {}, {}, {}
    for i, rules in enumerate(protocols):
        k, n = int(success[i].sum()), len(success[i])
        rates[rules.label] = (k / n, *wilson_interval(k, n))
        if rules.perturbations.trials > 1:
            held_in[rules.label] = mean_share(torch.cat([t.results[i].robustness for t in parts]))
        fingers[rules.label] = finger_contact(torch.cat([t.results[i].fingers_in_contact for t in parts]), parts[0].fingers)
    held = GraspBatch.concatenate([t.grasps.replace(extra={}) for t in parts])[success[0]]
    first = [t.results[0] for t in parts]
    areas = {
        rules.label: _mean([roc_area(t.grasps.score, t.results[i].success) for t in parts])
        for i, rules in enumerate(protocols)
    }
    seconds = {name: _mean([t.seconds[name] for t in parts]) for name in parts[0].seconds}
    return Row(
        source, stage, parts[0].grasps.hand, len(success[0]), rates,
        displacement=float(torch.cat([r.displacement[r.success, -1] for r in first]).mean()),
        rotation=float(torch.cat([r.rotation[r.success, -1] for r in first]).mean()),
        diversity=diversity(held.T_object_wrist, held.joints)["all"], trials_held=held_in, fingers=fingers, ranking=areas,
        seconds=seconds,
    )


def _average(rows: list[Row]) -> Row:
    """The mean over hands; its interval is that of all grasps, of which every hand has the same number."""
    total = sum(r.num for r in rows)
    return replace(
        rows[0], hand=ALL, num=total, success=_average_rates([r.success for r in rows], total),
        trials_held=_average_rates([r.trials_held for r in rows], total),
        fingers={
            label: (_mean([r.fingers[label][0] for r in rows]), _mean([r.fingers[label][1] for r in rows]))
            for label in rows[0].fingers
        },
        displacement=_mean([r.displacement for r in rows]), rotation=_mean([r.rotation for r in rows]),
        diversity=_mean([r.diversity for r in rows]),
        ranking={label: _mean([r.ranking[label] for r in rows]) for label in rows[0].ranking},
        seconds={name: _mean([r.seconds[name] for r in rows]) for name in rows[0].seconds},
    )


def _average_rates(rates: list[dict[str, tuple[float, float, float]]], total: int) -> dict[str, tuple[float, float, float]]:
    """Per protocol the mean over hands, with the interval of as many grasps."""
    means = {label: _mean([rate[label][0] for rate in rates]) for label in rates[0]}
    return {label: (mean, *wilson_interval(round(mean * total), total)) for label, mean in means.items()}


def _mean(values: Sequence[float]) -> float:
    """The mean of the numbers among them; NaN without any."""
    numbers = [v for v in values if math.isfinite(v)]
    return sum(numbers) / len(numbers) if numbers else math.nan
