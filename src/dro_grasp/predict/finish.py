"""What becomes of candidates, whoever proposed them: refined, admitted, scored, settled, chosen, weighed, eased.

Measurements say that this does most of the work, so predictor, benchmark and arm share it. No trial decides here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from dro_grasp.devices import Stopwatch
from dro_grasp.errors import OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.kinds import Checked
from dro_grasp.optimize.fingers import EasingConfig
from dro_grasp.optimize.refinement import RefineConfig
from dro_grasp.predict.admission import TURNED, AdmissionConfig, count_violations, feasible
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.score.holding import Evidence, holding_score
from dro_grasp.predict.score.score import ScoreConfig
from dro_grasp.predict.settling import SettleConfig, SettledBest, can_settle, settle_best_all, weigh_settled_all
from dro_grasp.predict.sources.source import Candidates
from dro_grasp.predict.stages import complete, ease, refine_all, score_all
from dro_grasp.simulation.weighing import WeighingConfig

LEAST_CONFIDENCE = 0.2
"""Grasps that hold with less probability are not returned. Ours: see the notebook of `carry` for what other values cost."""


@dataclass(frozen=True)
class FinishConfig(Checked):
    """The stages of finishing. A stage that is None is left out."""

    refine: RefineConfig | None = field(default_factory=RefineConfig)
    """Descent near each candidate; without it candidates get the pregrasp and squeeze of the paper's controller."""
    admission: AdmissionConfig = field(default_factory=AdmissionConfig)
    """By how much grasps may miss what the constraints ask."""
    score: ScoreConfig = field(default_factory=ScoreConfig)
    """How grasps are ranked."""
    settle: SettleConfig | None = field(default_factory=SettleConfig)
    """Simulated closing of the better share; a hand without its description cannot settle."""
    weigh: WeighingConfig | None = field(default_factory=WeighingConfig)
    """How payloads of what is returned are found in simulation; without it they are predicted."""
    ease: EasingConfig | None = field(default_factory=EasingConfig)
    """Room that fingers leave on a bare cloud."""

    least_confidence: float = field(default_factory=lambda: LEAST_CONFIDENCE)
    """Grasps that hold with less probability are not returned."""

    def __post_init__(self) -> None:
        """Refuse a confidence that is no probability below one: OptionError."""
        super().__post_init__()
        check_confidence(self.least_confidence)

    @staticmethod
    def nothing() -> FinishConfig:
        """Candidates as they come, scored and admitted alone."""
        return FinishConfig(refine=None, settle=None, weigh=None, ease=None, least_confidence=0.0)


def check_confidence(least: float) -> None:
    """Refuse a least confidence that is no probability below one: OptionError."""
    if not 0 <= least < 1:
        raise OptionError(f"least_confidence is {least}; give a probability from 0, which returns everything, to below 1")


@dataclass(frozen=True)
class Finished:
    """Candidates after all stages, and the best of them."""

    problem: GraspProblem
    """Hand, object and constraints."""
    config: FinishConfig
    """The stages."""
    keep: int
    """Grasps that are wanted."""
    pool: GraspBatch
    """All that may be chosen, with scores, in the order in which they were proposed."""
    candidates: Candidates
    """The same rows as they were proposed."""
    refined: GraspBatch
    """What the last call refined, admitted and scored, before it settled any."""
    made: int
    """Candidates made, those that constraints rejected included."""
    dropped: Counter[str]
    """Those that constraints rejected, by reason."""
    seconds: dict[str, float]
    """Time by stage [s]."""
    doubts: tuple[str, ...] = ()
    """What closing showed against each of the pool, in words; empty for nothing."""
    watch: Stopwatch = field(default_factory=lambda: Stopwatch("weigh", "ease"))
    """Time of what is done to the best alone, once `grasps` was asked for [s]."""

    @cached_property
    def rows(self) -> Int[Tensor, " k"]:
        """Rows of the best in the pool, the best score first, without those that are not trusted enough."""
        return self.best(torch.ones_like(self.trusted))

    def best(self, allowed: Bool[Tensor, " n"]) -> Int[Tensor, " k"]:
        """The same of these rows alone; others may be of any score."""
        rows = allowed.nonzero()[:, 0]
        best = rows[(-self.pool.score[rows]).argsort(stable=True)[: self.keep]]
        return best[self.trusted[best]]

    def among(self, rows: Int[Tensor, " k"]) -> Finished:
        """As if these rows were all of the pool."""
        return replace(self, pool=self.pool[rows], candidates=self.candidates[rows],
                       doubts=tuple(self.doubts[row] for row in rows.tolist()))

    @cached_property
    def trusted(self) -> Bool[Tensor, " n"]:
        """Which of the pool are confident enough to be returned."""
        return ~(self.pool.confidence < self.config.least_confidence)

    @property
    def doubted(self) -> Counter[str]:
        """How many of the pool are not, by what closing showed against them."""
        return Counter(why for why, trusted in zip(self.doubts, self.trusted.tolist(), strict=True) if not trusted)

    @cached_property
    def grasps(self) -> GraspBatch:
        """The best, complete, weighed and eased, as they are returned."""
        return complete_grasps([self])[0]

    @property
    def proposed(self) -> Candidates:
        """The best as they were proposed."""
        return self.candidates[self.rows]

    def beside(self, rivals: Finished) -> Finished:
        """With finished candidates of earlier calls, which stay in the choice."""
        seconds = {name: rivals.seconds[name] + spent for name, spent in self.seconds.items()}
        return Finished(
            self.problem, self.config, self.keep, GraspBatch.concatenate([rivals.pool, self.pool]),
            Candidates.concatenate([rivals.candidates, self.candidates]), self.refined, rivals.made + self.made,
            rivals.dropped + self.dropped, seconds, (*rivals.doubts, *self.doubts))

    def lacking(self, least_score: float) -> int:
        """How many of the wanted grasps are missing, or score no better than `least_score`."""
        return max(0, self.keep - int((self.pool.score > least_score).sum()))


def finish(
    problem: GraspProblem, candidates: Candidates, config: FinishConfig | None = None, keep: int = 16,
    rivals: Finished | None = None,
) -> Finished:
    """Make grasps of candidates, and choose the best of them and of earlier ones.

    Args:
        problem: Hand, object and constraints.
        candidates: Of any source.
        config: The stages.
        keep: Grasps that are wanted.
        rivals: Finished candidates of earlier calls, which stay in the choice.

    Raises:
        GraspFileError: The candidates are of another hand.
    """
    return finish_all([problem], [candidates], config, keep, [rivals])[0]


def finish_all(
    problems: Sequence[GraspProblem], candidates: Sequence[Candidates], config: FinishConfig | None = None, keep: int = 16,
    rivals: Sequence[Finished | None] | None = None,
) -> list[Finished]:
    """The same for several objects, together where that is quicker; each takes an equal share of the time."""
    config, watch = config or FinishConfig(), Stopwatch("refine", "rank", "settle")
    with watch("refine"):
        whole = _refined(problems, candidates, config)
    allowed = [feasible(problem, grasps, config.admission) for problem, grasps in zip(problems, whole, strict=True)]
    dropped = [Counter({TURNED: own.turned}) + count_violations(problem, grasps[~kept], config.admission)
               for problem, own, grasps, kept in zip(problems, candidates, whole, allowed, strict=True)]
    with watch("rank"):
        refined = score_all(problems, [grasps[kept] for grasps, kept in zip(whole, allowed, strict=True)], config.score)
    admitted = [own[kept] for own, kept in zip(candidates, allowed, strict=True)]
    if config.settle is None:
        settled = [SettledBest(torch.arange(len(grasps)), grasps, ("",) * len(grasps)) for grasps in refined]
    else:
        settled = _settled(problems, refined, keep, config, config.settle, watch)
    seconds = {name: spent / len(problems) for name, spent in watch.seconds.items()}
    made = [len(own) + own.turned for own in candidates]
    done = [Finished(problem, config, keep, own.grasps, admitted[i][own.rows], refined[i], made[i], dropped[i], dict(seconds),
                     own.doubts) for i, (problem, own) in enumerate(zip(problems, settled, strict=True))]
    return done if rivals is None else [own if other is None else own.beside(other) for own, other in zip(
        done, rivals, strict=True)]


def complete_grasps(finished: Sequence[Finished]) -> list[GraspBatch]:
    """What `Finished.grasps` is of several objects of a hand, together where that is quicker; each then knows it."""
    lacking = [own for own in finished if "grasps" not in vars(own)]
    best = [own.problem.on_table(own.pool[own.rows]) for own in lacking]
    for grasps, own in zip(_weighed(lacking, best), lacking, strict=True):
        vars(own)["grasps"] = grasps
        if own.config.ease is not None:
            with own.watch("ease"):
                vars(own)["grasps"] = ease(own.problem, grasps, own.config.ease, own.config.admission)
    return [own.grasps for own in finished]


def _weighed(finished: Sequence[Finished], best: Sequence[GraspBatch]) -> list[GraspBatch]:
    """The best grasps with payloads that were found in simulation; each takes an equal share of the time."""
    found = list(best)
    for config in dict.fromkeys((own.config.weigh, own.config.settle) for own in finished):
        weighing, settling = config
        rows = [i for i, own in enumerate(finished) if (own.config.weigh, own.config.settle) == config
                and bool(best[i].payload.isfinite().any())]
        if weighing is None or settling is None or not rows:
            continue
        watch = Stopwatch()
        with watch("weigh"):
            payloads = weigh_settled_all([finished[i].problem for i in rows], [best[i] for i in rows], weighing, settling)
        for i, payload in zip(rows, payloads, strict=True):
            found[i] = best[i].replace(payload=payload)
            finished[i].watch.seconds["weigh"] += watch.seconds["weigh"] / len(rows)
    return found


def _refined(
    problems: Sequence[GraspProblem], candidates: Sequence[Candidates], config: FinishConfig
) -> list[GraspBatch]:
    """Complete grasps of all candidates, refined unless they are exact."""
    rough = [] if config.refine is None else [i for i, own in enumerate(candidates) if not own.exact]
    found = dict(zip(rough, refine_all(
        [problems[i] for i in rough], [candidates[i].grasps for i in rough], config.refine), strict=True))
    return [found[i] if i in found else complete(problem, own.grasps) for i, (problem, own) in enumerate(
        zip(problems, candidates, strict=True))]


def _settled(
    problems: Sequence[GraspProblem], refined: Sequence[GraspBatch], keep: int, config: FinishConfig,
    settling: SettleConfig, watch: Stopwatch,
) -> list[SettledBest]:
    """What is in the choice of each: the better share, settled; all, where the hand cannot settle."""
    rows = [i for i, problem in enumerate(problems) if can_settle(problem) and len(refined[i])]
    made: dict[int, SettledBest] = {}
    if rows:
        with watch("settle"):
            some = settle_best_all(
                [problems[i] for i in rows], [refined[i] for i in rows], keep, settling, config.score, config.admission)
        made = dict(zip(rows, some, strict=True))
    for i, (problem, grasps) in enumerate(zip(problems, refined, strict=True)):
        if i not in made:
            score = holding_score(grasps.score, Evidence.none(len(grasps), problem.mass))
            made[i] = SettledBest(torch.arange(len(grasps)), grasps.replace(score=score), ("",) * len(grasps))
    return [made[i] for i in range(len(problems))]
