"""Success rates of a network and of its controls, before and after refinement and ranking.

Source: paper section IV; the stages, the controls and the trials beside the paper's are ours.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from dro_grasp.datasets.bundle.training_file import Bundle
from dro_grasp.evaluation.controls import controls
from dro_grasp.evaluation.equal_time import control_makers, equal_time, network_maker
from dro_grasp.evaluation.rows import EvaluatedGrasps, Row, average, hand_row
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.perception.partial_views import View, partial_view
from dro_grasp.pipeline.problem import GraspProblem
from dro_grasp.pipeline.settling import best_settled, can_settle
from dro_grasp.pipeline.stages import refine, scored
from dro_grasp.predictor import GraspPredictor, GraspRequest
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
SETTLED = "settled"
"""Stage: refined grasps after closing in simulation."""
SETTLED_BEST = "settled, ranked"
"""Stage: the best quarter of the settled grasps by score."""
TOP = {f"refined, top {count}": count for count in (5, 1)}
"""Stages that keep the few best refined grasps of a pair by score, and how many."""
STAGES = (RAW, RANKED, REFINED, BEST, *TOP, SETTLED, SETTLED_BEST)
"""Stages of every source."""
RETURNED = "returned"
"""Stage: what `generate` returns, with candidates of the network and, where the score asks for them, of the optimiser."""
EQUAL_TIME = "equal-time"
"""Stage: the best that each source returns with the CPU time of the network's best quarter."""
NETWORK = "network"
"""Source: the network under test."""
BOTH = "network and optimiser"
"""Source: the network, and the optimiser where the score does not trust it."""
KEPT = 0.25
"""Share of the grasps of a pair that ranking keeps, before any trial."""


@dataclass(frozen=True)
class BenchmarkConfig:
    """What is measured."""

    num: int = 100
    """Grasps of each hand on each object, before ranking; RETURNED and EQUAL_TIME return as many as ranking keeps of them."""
    stages: tuple[str, ...] = STAGES
    """Which of STAGES, RETURNED and EQUAL_TIME."""
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
                for source, stage, evaluated in _measured(problem, predictor, config, bundle, seed):
                    found.setdefault((source, stage), []).append(evaluated)
            done += 1
            if progress is not None:
                progress(done, pairs)
        for key, evaluated in found.items():
            table.setdefault(key, []).append(evaluated)
    rows = []
    for (source, stage), per_hand in table.items():
        single = [hand_row(source, stage, evaluated, config.protocols) for evaluated in per_hand]
        rows += single if len(single) == 1 else [*single, average(single)]
    return rows


def pair_seed(seed: int, hand: Hand, obj: ObjectModel) -> int:
    """Seed of one pair: with the same z on all objects, grasps of different pairs would not be independent."""
    return seed + zlib.crc32(f"{hand.name} {obj.name}".encode())


def view_seeds(config: BenchmarkConfig, hand: Hand, obj: ObjectModel) -> range:
    """Seeds of a pair's views; the first is the pair's own."""
    first = pair_seed(config.seed, hand, obj)
    return range(first, first + config.views)


def _measured(
    problem: GraspProblem, predictor: GraspPredictor, config: BenchmarkConfig, bundle: Bundle | None, seed: int
) -> Iterator[tuple[str, str, EvaluatedGrasps]]:
    """Source, stage and grasps of one view of a pair, for the stages asked for. Trials see the whole object."""
    hand, obj, num = problem.hand, problem.obj, config.num
    visible = problem if config.view == "whole" else GraspProblem(hand, partial_view(obj, config.view, seed), predictor.device)
    rivals = controls(problem, bundle) if config.controls else {}
    keep = _quarter(num)
    if set(config.stages) & set(STAGES):
        made = predictor.run(visible, GraspRequest(num, seed, candidates=1, refine=False, method="network"))
        network = _Source(NETWORK, visible, made.grasps, {k: made.seconds[k] / num for k in ("network", "decode")})
        yield from _stages(network, obj, config)
        for name, make in rivals.items():
            begin = time.perf_counter()
            grasps = make(num, seed)
            yield from _stages(_Source(name, problem, grasps, {"make": (time.perf_counter() - begin) / num}), obj, config)
    if RETURNED in config.stages:
        made = predictor.run(visible, GraspRequest(keep, seed, candidates=round(1 / KEPT)))
        seconds = {part: value / keep for part, value in made.seconds.items()}
        yield BOTH, RETURNED, _evaluated(hand, obj, made.grasps, config, seconds, made.candidates)
    if EQUAL_TIME in config.stages:
        makers = {NETWORK: network_maker(visible, predictor), **control_makers(problem, rivals, keep)}
        for name, best in equal_time(makers, num, keep, seed).items():
            seconds = {"CPU": best.seconds / max(1, len(best.grasps))}
            yield name, EQUAL_TIME, _evaluated(hand, obj, best.grasps, config, seconds, best.candidates)


@dataclass(frozen=True)
class _Source:
    """Grasps before any stage."""

    name: str
    problem: GraspProblem
    """The hand, and what is seen of the object."""
    grasps: GraspBatch
    seconds: dict[str, float]
    """Time to make one of them, by part [s]."""


class _Step(NamedTuple):
    """A stage of all grasps of a source, which takes those of the stage before."""

    stage: str
    best: dict[str, int]
    """Stages that keep the best of them by score, and how many."""
    part: str = ""
    """Name of its time."""
    make: Callable[[GraspProblem, GraspBatch], GraspBatch] | None = None


def _stages(source: _Source, obj: ObjectModel, config: BenchmarkConfig) -> Iterator[tuple[str, str, EvaluatedGrasps]]:
    """Those stages of a source that are asked for; what several of them share is made once."""
    asked = set(config.stages)
    problem, grasps, seconds = source.problem, source.grasps, source.seconds
    quarter = _quarter(len(grasps))
    steps = [_Step(RAW, {RANKED: quarter}), _Step(REFINED, {BEST: quarter, **TOP}, "refine", refine)]
    if can_settle(problem):
        steps.append(_Step(SETTLED, {SETTLED_BEST: quarter}, "settle", _settle))
    last = max((i for i, step in enumerate(steps) if asked & {step.stage, *step.best}), default=-1)
    for step in steps[: last + 1]:
        if step.make is not None:
            begin = time.perf_counter()
            grasps = step.make(problem, grasps)
            seconds = seconds | {step.part: (time.perf_counter() - begin) / max(1, len(grasps))}
        if not asked & {step.stage, *step.best}:
            continue
        if grasps.score.isnan().any():
            grasps = scored(problem, grasps)
        evaluated = _evaluated(problem.hand, obj, grasps, config, seconds, config.num)
        if step.stage in asked:
            yield source.name, step.stage, evaluated
        for stage, count in step.best.items():
            if stage in asked:
                yield source.name, stage, evaluated.rows(grasps.score.topk(min(count, len(grasps))).indices)


def _settle(problem: GraspProblem, grasps: GraspBatch) -> GraspBatch:
    """All the grasps settled; those that lose the object stay as they were, with a low score."""
    return best_settled(problem, scored(problem, grasps), len(grasps))[1]


def _quarter(num: int) -> int:
    """How many of the grasps of a pair ranking keeps."""
    return max(1, round(KEPT * num))


def _evaluated(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, config: BenchmarkConfig, seconds: dict[str, float], candidates: int
) -> EvaluatedGrasps:
    """Grasps after all trials."""
    results = tuple(simulate(hand, obj, grasps, rules, workers=config.workers) for rules in config.protocols)
    return EvaluatedGrasps(grasps, results, seconds, len(hand.fingers), candidates)
