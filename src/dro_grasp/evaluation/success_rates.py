"""The tables of the paper: grasps of a network and of its controls, before and after ranking and refinement.

Source: paper section IV; the stages, the controls and the stricter trials beside the paper's are ours.
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
from dro_grasp.evaluation.metrics import diversity, roc_area, wilson_interval
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimization.refinement import refine_grasps
from dro_grasp.optimization.synthesis import synthesize
from dro_grasp.perception.partial_views import View, seen
from dro_grasp.predictor import GraspPredictor
from dro_grasp.ranking.score import score_grasps
from dro_grasp.simulation.outcome import TrialResult
from dro_grasp.simulation.protocols import Protocol
from dro_grasp.simulation.trial import settle, simulate

RAW, RANKED, REFINED, BEST = "raw", "ranked", "refined", "refined, ranked"
TOP = {f"refined, top {count}": count for count in (5, 1)}
"""Stages that keep the few best by score of the polished grasps of a pair, and how many."""
STAGES = (RAW, RANKED, REFINED, BEST, *TOP)
"""As they come; the best quarter by score; polished; polished, then the best quarter, the best five, the best one."""
NETWORK, MEAN, START, SYNTHESISED = "network", "mean grasp", "unoptimised start", "synthesised"
ALL = "average"
"""Name of the row over all hands."""
KEPT = 0.25
"""Share of the grasps of a pair that ranking keeps, decided before any trial."""
CANDIDATES = 4
"""Candidates that synthesis makes for each grasp that it is asked for; the paper's baseline keeps its best as well."""


@dataclass(frozen=True)
class BenchmarkConfig:
    """What is measured."""

    num: int = 100
    """Grasps of each hand on each object, before ranking."""
    stages: tuple[str, ...] = STAGES
    """Which of STAGES."""
    protocols: tuple[Protocol, ...] = ()
    """Trials that every grasp goes through."""
    controls: bool = True
    """Also the rows that success means nothing without."""
    view: View = "whole"
    """What the network, refinement and ranking see of the object; controls see all of it."""
    looks: int = 1
    """How often each pair is taken up, with other random numbers and seen from another side, for `num` grasps each time."""
    seed: int = 0
    """Of all grasps and views; each pair's are derived from it."""
    workers: int | None = None
    """Threads of the trials; all cores by default."""


@dataclass(frozen=True)
class Tried:
    """Grasps of one hand on one object, after all trials."""

    grasps: GraspBatch
    results: tuple[TrialResult, ...]
    """One for each protocol."""
    seconds: dict[str, float]
    """What making one grasp took, by part [s]."""

    def rows(self, index: Int[Tensor, " k"]) -> Tried:
        """Some of the grasps; a trial's outcome depends on nothing but the grasp."""
        return Tried(self.grasps[index], tuple(r.rows(index) for r in self.results), self.seconds)


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    grasps: str
    """Where they come from."""
    stage: str
    hand: str
    num: int
    """Grasps tried."""
    success: dict[str, tuple[float, float, float]]
    """Per protocol the share of successes and its 95 % interval (Wilson); the mean over hands in the row of all."""
    displacement: float
    """Mean displacement of the object over successes of the first protocol [m]."""
    rotation: float
    """Mean rotation of the object, likewise [rad]."""
    diversity: float
    """The paper's measure over successes of the first protocol, mixing m and rad as the paper does."""
    ranking: dict[str, float]
    """Per protocol the area under the ROC curve of score against success, within each pair."""
    seconds: dict[str, float]
    """Time of one grasp by part [s]."""


def benchmark(
    hands: Sequence[Hand],
    objects: Sequence[ObjectModel],
    predictor: GraspPredictor,
    config: BenchmarkConfig,
    bundle: Bundle | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Fill the table.

    Args:
        hands: Which hands.
        objects: Which objects, all with meshes.
        predictor: The network under test.
        config: Numbers, stages and protocols.
        bundle: Training data that the mean grasp is the mean of; hands that are not in it have no such rows.
        progress: Called with (pairs done, pairs in all).
    """
    table: dict[tuple[str, str], list[list[Tried]]] = {}
    done, pairs = 0, len(hands) * len(objects)
    for hand in hands:
        found: dict[tuple[str, str], list[Tried]] = {}
        for obj in objects:
            for seed in look_seeds(config, hand, obj):
                for source, grasps, seconds, known in _sources(hand, obj, predictor, config, bundle, seed):
                    for stage, tried in _stages(hand, obj, known, source, grasps, seconds, config):
                        found.setdefault((source, stage), []).append(tried)
            done += 1
            if progress is not None:
                progress(done, pairs)
        for key, tries in found.items():
            table.setdefault(key, []).append(tries)
    rows = []
    for (source, stage), per_hand in table.items():
        single = [_row(source, stage, tries, config.protocols) for tries in per_hand]
        rows += single if len(single) == 1 else [*single, _average(single)]
    return rows


def pair_seed(seed: int, hand: Hand, obj: ObjectModel) -> int:
    """Seed of one pair: the same z on all objects would pass for independent grasps."""
    return seed + zlib.crc32(f"{hand.name} {obj.name}".encode())


def look_seeds(config: BenchmarkConfig, hand: Hand, obj: ObjectModel) -> range:
    """Seeds of a pair's looks; the first is the pair's."""
    first = pair_seed(config.seed, hand, obj)
    return range(first, first + config.looks)


def _sources(
    hand: Hand, obj: ObjectModel, predictor: GraspPredictor, config: BenchmarkConfig, bundle: Bundle | None, seed: int
) -> Iterator[tuple[str, GraspBatch, dict[str, float], ObjectModel]]:
    """Grasps by where they come from, unpolished, the time that one of them took [s], and what was seen of the object."""
    num = config.num
    known = seen(obj, config.view, seed)
    grasps = predictor.predict(hand, known, num=num, seed=seed, refine=False)
    yield NETWORK, grasps, {k: predictor.timings[k] / num for k in ("network", "decode")}, known
    if not config.controls:
        return
    if bundle is not None and hand.name in bundle.grasps:
        yield MEAN, mean_grasps(hand, obj, mean_grasp(bundle, hand.name), num, seed), {}, obj
    yield START, palm_facing_starts(hand, obj, num, seed), {}, obj
    begin = time.perf_counter()
    made = settle(hand, obj, synthesize(hand, obj, CANDIDATES * num, seed)[slice(0, num)], workers=config.workers)
    yield SYNTHESISED, made, {"synthesis": (time.perf_counter() - begin) / num}, obj


def _stages(
    hand: Hand,
    obj: ObjectModel,
    known: ObjectModel,
    source: str,
    grasps: GraspBatch,
    seconds: dict[str, float],
    config: BenchmarkConfig,
) -> Iterator[tuple[str, Tried]]:
    """The stages asked for; what several of them share is made once."""
    asked = {RAW} if source in {START, SYNTHESISED} else set(config.stages)
    quarter = max(1, round(KEPT * len(grasps)))
    for whole, best in ((RAW, {RANKED: quarter}), (REFINED, {BEST: quarter, **TOP})):
        wanted = {whole, *best} & asked
        if not wanted:
            continue
        if whole == REFINED:
            begin = time.perf_counter()
            grasps = refine_grasps(hand, known, grasps)
            seconds = seconds | {"refine": (time.perf_counter() - begin) / len(grasps)}
        grasps = grasps.replace(score=score_grasps(hand, known, grasps))
        results = tuple(simulate(hand, obj, grasps, rules, workers=config.workers) for rules in config.protocols)
        tried = Tried(grasps, results, seconds)
        if whole in wanted:
            yield whole, tried
        for stage, count in best.items():
            if stage in wanted:
                yield stage, tried.rows(grasps.score.topk(min(count, len(grasps))).indices)


def _row(source: str, stage: str, tries: list[Tried], protocols: Sequence[Protocol]) -> Row:
    """One hand's line."""
    success = [torch.cat([t.results[i].success for t in tries]) for i in range(len(protocols))]
    rates = {}
    for rules, passed in zip(protocols, success, strict=True):
        k, n = int(passed.sum()), len(passed)
        rates[rules.label] = (k / n, *wilson_interval(k, n))
    held = GraspBatch.concatenate([t.grasps.replace(extra={}) for t in tries])[success[0]]
    first = [t.results[0] for t in tries]
    areas = {
        rules.label: _mean([roc_area(t.grasps.score, t.results[i].success) for t in tries])
        for i, rules in enumerate(protocols)
    }
    parts = {name: _mean([t.seconds[name] for t in tries]) for name in tries[0].seconds}
    return Row(
        source, stage, tries[0].grasps.hand, len(success[0]), rates,
        displacement=float(torch.cat([r.displacement[r.success, -1] for r in first]).mean()),
        rotation=float(torch.cat([r.rotation[r.success, -1] for r in first]).mean()),
        diversity=diversity(held.T_object_wrist, held.joints)["all"], ranking=areas, seconds=parts,
    )


def _average(rows: list[Row]) -> Row:
    """The mean over hands; its interval is that of all grasps, of which every hand has the same number."""
    total = sum(r.num for r in rows)
    success = {}
    for label in rows[0].success:
        mean = _mean([r.success[label][0] for r in rows])
        success[label] = (mean, *wilson_interval(round(mean * total), total))
    return replace(
        rows[0], hand=ALL, num=total, success=success,
        displacement=_mean([r.displacement for r in rows]), rotation=_mean([r.rotation for r in rows]),
        diversity=_mean([r.diversity for r in rows]),
        ranking={label: _mean([r.ranking[label] for r in rows]) for label in rows[0].ranking},
        seconds={name: _mean([r.seconds[name] for r in rows]) for name in rows[0].seconds},
    )


def _mean(values: Sequence[float]) -> float:
    """The mean of the numbers among them; NaN without any."""
    numbers = [v for v in values if math.isfinite(v)]
    return sum(numbers) / len(numbers) if numbers else math.nan
