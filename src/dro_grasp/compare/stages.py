"""Success rates of methods, before and after refinement and ranking, and with equal time.

Source: paper section IV; the stages, the methods and the trials beside the paper's are ours.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch

from dro_grasp.compare.methods import Method
from dro_grasp.compare.rows import EvaluatedGrasps, Row, average, hand_row
from dro_grasp.devices import one_thread
from dro_grasp.errors import NoGraspError, OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import Checked, require_seed
from dro_grasp.objects.perception.partial_views import View, partial_view
from dro_grasp.objects.shape import ObjectModel, with_mass
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.finish import finish
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.settling import can_settle
from dro_grasp.predict.stages import ease, scored
from dro_grasp.simulation.contacts import with_contacts
from dro_grasp.simulation.protocols import Protocol
from dro_grasp.simulation.trial import simulate

RAW = "raw"  # Stage: grasps as they come
RANKED = "ranked"  # Stage: the best quarter of them by score
REFINED = "refined"  # Stage: refined grasps
BEST = "refined, ranked"  # Stage: the best quarter of the refined grasps by score
SETTLED = "settled"  # Stage: refined grasps after closing in simulation
SETTLED_BEST = "settled, ranked"  # Stage: the best quarter of the settled grasps by score
TOP = {f"refined, top {count}": count for count in (5, 1)}
"""Stages that keep the few best refined grasps of a pair by score, and how many."""
AFTER_REFINEMENT = (REFINED, BEST, *TOP)  # Stages of refined grasps
AFTER_SETTLING = (SETTLED, SETTLED_BEST)  # Stages of settled grasps
STAGES = (RAW, RANKED, *AFTER_REFINEMENT, *AFTER_SETTLING)  # Stages of every method
RETURNED = "returned"
"""Stage: what a method returns to a user; `generate`, with candidates of the network and, where the score asks for them, of
the optimiser."""
EQUAL_TIME = "equal-time"  # Stage: the best that each method returns with the CPU time of the first method's best quarter
KEPT = 0.25  # Share of the grasps of a pair that ranking keeps, before any trial
Maker = Callable[[int, int], GraspBatch]  # Makes a number of grasps with scores from a seed
SMALLEST_ROUND = 0.1  # A method goes on if this share of the candidates that it has made still fits into the time (ours)


@dataclass(frozen=True)
class BenchmarkConfig(Checked):
    """What is measured."""

    num: int = 100
    """Grasps of each hand on each object, before ranking; RETURNED and EQUAL_TIME return as many as ranking keeps of them."""
    stages: tuple[str, ...] = STAGES  # Which of STAGES, RETURNED and EQUAL_TIME
    protocols: tuple[Protocol, ...] = ()  # Trials of every grasp
    view: View = "whole"  # What methods, refinement and ranking see of the object; trials are on all of it
    views: int = 1  # Views of each object for each hand, with other random numbers and `num` grasps each
    seed: int = 0  # Of all grasps and views; each pair's seeds are derived from it
    workers: int | None = None  # Threads of the trials; all cores by default
    device: str = "cpu"  # Where the grasp energy is computed
    mass: float | None = None  # Mass of every object [kg]; its own by default
    constraints: Constraints = field(default_factory=Constraints)  # What grasps have to respect
    contact_quality: bool = False  # Whether contacts are measured too, as DexGraspBench does

    def __post_init__(self) -> None:
        """Refuse seeds out of range: OptionError."""
        super().__post_init__()
        require_seed(self.seed, 62)  # those of pairs are larger


def benchmark(
    hands: Sequence[Hand], objects: Sequence[ObjectModel], methods: Sequence[Method], config: BenchmarkConfig,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Measure the success rates on objects with meshes; a method has no rows of hands that it does not know.

    `progress` is called with (pairs done, pairs in all).

    Raises:
        OptionError: Two methods have one name, or a method returns more grasps than it was asked for.
        GraspFileError: A grasp file lacks grasps of an object; this is known before anything is measured.
    """
    names = [method.name for method in methods]
    if twice := [name for name in names if names.count(name) > 1]:
        raise OptionError(f"two methods are called '{twice[0]}' and would share rows; give one of them another name")
    table: dict[tuple[str, str], list[list[EvaluatedGrasps]]] = {}
    done, pairs = 0, len(hands) * len(objects)
    objects = [obj if config.mass is None else with_mass(obj, config.mass) for obj in objects]
    for method in (method for method in methods if any(map(method.knows, hands))):
        for obj in objects:
            method.asked(obj, config.num)
    for hand in hands:
        found: dict[tuple[str, str], list[EvaluatedGrasps]] = {}
        for obj in objects:
            known = [method for method in methods if method.knows(hand)]
            whole = GraspProblem(hand, obj, config.device, config.constraints)
            for seed in view_seeds(config, hand, obj):
                problem = whole
                if config.view != "whole":
                    seen = partial_view(obj, config.view, seed)
                    seen = seen if config.mass is None else with_mass(seen, config.mass)
                    problem = GraspProblem(hand, seen, config.device, config.constraints)
                for name, stage, evaluated in _measured(problem, obj, known, config, seed):
                    found.setdefault((name, stage), []).append(evaluated)
            done += 1
            if progress is not None:
                progress(done, pairs)
        for key, evaluated in found.items():
            table.setdefault(key, []).append(evaluated)
    rows = []
    for (name, stage), per_hand in table.items():
        single = [hand_row(name, stage, evaluated, config.protocols) for evaluated in per_hand]
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
    problem: GraspProblem, obj: ObjectModel, methods: Sequence[Method], config: BenchmarkConfig, seed: int
) -> Iterator[tuple[str, str, EvaluatedGrasps]]:
    """Method, stage and grasps of one view of a pair, for the stages asked for. Trials see the whole object."""
    hand, num, keep = problem.hand, config.num, _quarter(config.num)
    _ = problem.field  # what methods share is prepared before a clock runs
    for method in methods:
        if set(config.stages) & set(STAGES):
            yield from _stages(method, problem, obj, config, seed)
        if RETURNED in config.stages:
            begin = time.perf_counter()
            grasps, made = _returned(method, problem, keep, seed)
            seconds = {"make": (time.perf_counter() - begin) / keep}
            grasps = grasps.with_asked(method.asked(obj, keep))
            yield method.name, RETURNED, _evaluated(hand, obj, grasps, config, seconds, made)
    if EQUAL_TIME in config.stages and methods:
        makers = {method.name: finished_maker(problem, method, keep) for method in methods}
        asked = {method.name: method.asked(obj, keep) for method in methods}
        for name, best in equal_time(makers, num, keep, seed).items():
            seconds = {"CPU": best.seconds / max(1, len(best.grasps))}
            grasps = best.grasps.with_asked(asked[name])
            yield name, EQUAL_TIME, _evaluated(hand, obj, grasps, config, seconds, best.candidates)


def _returned(method: Method, problem: GraspProblem, keep: int, seed: int) -> tuple[GraspBatch, int]:
    """What a method returns to a user, and how many candidates it made; nothing is an answer, too."""
    try:
        made = method.returned(problem, keep, seed)
        return made.grasps, made.candidates
    except NoGraspError:
        return GraspBatch.none(problem.hand, problem.obj), 0


def _stages(
    method: Method, problem: GraspProblem, obj: ObjectModel, config: BenchmarkConfig, seed: int
) -> Iterator[tuple[str, str, EvaluatedGrasps]]:
    """Those stages of a method that are asked for; its candidates are made and finished once for all of them."""
    asked, rules, per = set(config.stages), method.predictor.config.finish, max(1, config.num)
    candidates, num = method.propose(problem, config.num, seed), method.asked(obj, config.num)
    quarter = _quarter(num)
    seconds = {name: spent / per for name, spent in candidates.seconds.items()}
    found = [(scored(problem, candidates.grasps, rules.score), seconds, {RAW: num, RANKED: quarter})]
    if asked & {*AFTER_REFINEMENT, *AFTER_SETTLING}:
        settling = rules.settle if asked & set(AFTER_SETTLING) and can_settle(problem) else None
        every = None if settling is None else replace(settling, share=1.0)
        done = finish(problem, candidates, replace(rules, settle=every), num)
        seconds = seconds | {"refine": done.seconds["refine"] / per}
        found.append((done.refined, seconds, {REFINED: num, BEST: quarter, **TOP}))
        if every is not None:
            seconds = seconds | {"settle": done.seconds["settle"] / per}
            found.append((done.pool, seconds, {SETTLED: num, SETTLED_BEST: quarter}))
    for grasps, seconds, counts in found:
        if not asked & set(counts):
            continue
        given = grasps if RAW in counts else ease(problem, grasps, rules.ease, rules.admission)
        evaluated = _evaluated(problem.hand, obj, given.with_asked(num), config, seconds, config.num)
        for stage in counts:
            if stage in asked:
                best = evaluated if stage in (RAW, REFINED, SETTLED) else evaluated.best(min(counts[stage], num))
                yield method.name, stage, best


def _quarter(num: int) -> int:
    """How many of the grasps of a pair ranking keeps."""
    return max(1, round(KEPT * num))


def _evaluated(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, config: BenchmarkConfig, seconds: dict[str, float], candidates: int
) -> EvaluatedGrasps:
    """Grasps after all trials."""
    if config.contact_quality:
        grasps = with_contacts(hand, obj, grasps)
    results = tuple(simulate(hand, obj, grasps, rules, workers=config.workers, another=True) for rules in config.protocols)
    return EvaluatedGrasps(grasps, results, seconds, len(hand.fingers), candidates)


@dataclass(frozen=True)
class Returned:
    """What a method returns."""

    grasps: GraspBatch  # The best by score, best first
    candidates: int  # Grasps made, of which these are the best
    seconds: float  # CPU time of all of them [s]


def equal_time(
    makers: Mapping[str, Maker], num: int, keep: int, seed: int, clock: Callable[[], float] = time.process_time
) -> dict[str, Returned]:
    """The best `keep` candidates of each method, all in the time that the first one takes for `num`.

    Time is the CPU time of this process, with one thread of PyTorch: other programs make it wait, but hardly work longer. What
    is prepared once for a pair (distance field, contacts, collision scene) is not counted. Ours.
    """
    (first, make), *others = makers.items()
    with one_thread():
        make(keep, seed)
        begin = clock()
        grasps = make(num, seed)
        found = {first: Returned(_best(grasps, keep), num, clock() - begin)}
        for name, make in others:
            found[name] = best_within(found[first].seconds, make, keep, seed, clock)
    return found


def best_within(budget: float, make: Maker, keep: int, seed: int, clock: Callable[[], float]) -> Returned:
    """The best of as many candidates as fit into a time [s], by what one was measured to cost; of `keep` at least."""
    generator = torch.Generator().manual_seed(seed)

    def timed(num: int) -> tuple[GraspBatch, float]:
        begin = clock()
        grasps = make(num, int(torch.randint(2**31, (), generator=generator)))
        return grasps, clock() - begin

    _, cost = timed(keep)  # a rough measure, which also prepares what is shared; its time is not counted
    num, made, spent, pool = max(keep, int(budget * keep / cost)), 0, 0.0, []
    while num > SMALLEST_ROUND * made:
        grasps, seconds = timed(num)
        pool.append(grasps)
        made, spent = made + num, spent + seconds
        num = int((budget - spent) * made / spent)
    return Returned(_best(GraspBatch.concatenate(pool), keep), made, spent)


def finished_maker(problem: GraspProblem, method: Method, keep: int) -> Maker:
    """Candidates of a method, finished; of those that settle, `keep` at least."""
    config = method.predictor.config.finish

    def make(num: int, seed: int) -> GraspBatch:
        pool = finish(problem, method.propose(problem, num, seed), config, keep).pool
        return ease(problem, pool, config.ease, config.admission)

    return make


def _best(grasps: GraspBatch, keep: int) -> GraspBatch:
    """The best by score, each once: sources of stored grasps give the same ones again."""
    rows = torch.cat([grasps.T_object_wrist.flatten(1), grasps.joints], 1)
    first = {row.numpy().tobytes(): i for i, row in reversed(list(enumerate(rows)))}
    grasps = grasps[sorted(first.values())]
    return grasps[grasps.score.topk(min(keep, len(grasps))).indices]
