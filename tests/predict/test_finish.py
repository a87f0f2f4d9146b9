"""The one chain from candidates to grasps, against its single stages put together by hand."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from dataclasses import replace

import pytest
import torch

from dro_grasp.errors import OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.perception.partial_views import partial_view
from dro_grasp.optimize.fingers import EasingConfig
from dro_grasp.optimize.refinement import RefineConfig
from dro_grasp.predict.admission import TURNED, AdmissionConfig, count_violations, feasible
from dro_grasp.predict.config import GraspRequest
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.finish import FinishConfig, finish
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.score.holding import Evidence, holding_score
from dro_grasp.predict.settling import SettleConfig
from dro_grasp.predict.sources.controls import palm_facing_starts
from dro_grasp.predict.sources.source import Candidates
from dro_grasp.predict.stages import complete, ease, refine, scored
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.one_object import settle_grasps

HAND, CAN = loaded_hand("gripper3"), load_object("can")
WHOLE = GraspProblem(HAND, CAN)
BELOW = float(CAN.cloud[:, 2].min()) - 0.02
ON_TABLE = GraspProblem(HAND, CAN, constraints=Constraints(table=BELOW))
SEEN = GraspProblem(HAND, partial_view(CAN, "half", 0))
FIELDS = ("T_object_wrist", "joints", "pregrasp_joints", "squeeze_joints", "score")


def candidates(problem: GraspProblem, count: int = 16, seed: int = 0) -> Candidates:
    made = Candidates.of(problem, palm_facing_starts(HAND, problem.obj, count, seed))
    return replace(made, origin=tuple(f"start {seed}.{row}" for row in range(count)), turned=2)


def same(first: GraspBatch, second: GraspBatch) -> None:
    assert len(first) == len(second)
    for name in FIELDS:
        near = 1e-5 if name == "score" else 0  # one row is added up in another order than many
        torch.testing.assert_close(getattr(first, name), getattr(second, name), rtol=near, atol=near, msg=name)


def naive(problem: GraspProblem, made: Candidates, keep: int) -> tuple[GraspBatch, list[int], int]:
    """The same grasps from single stages, one candidate after the other where a stage allows it; and their rows, and how many
    the constraints let pass."""
    refined = refine(problem, made.grasps)
    passed = [row for row in range(len(made)) if bool(feasible(problem, refined[row : row + 1]))]
    known = scored(problem, refined[torch.tensor(passed, dtype=torch.long)])
    ranked = sorted(range(len(passed)), key=lambda row: -float(known.score[row]))
    better = sorted(ranked[: max(round(0.5 * len(passed)), min(math.ceil(1.5 * keep), len(passed)))])
    before = known[torch.tensor(better, dtype=torch.long)]
    closed, stable, known_of, _ = settle_grasps(problem, before)
    good = stable & feasible(problem, closed)
    poses = [(closed if bool(good[i]) else before)[i : i + 1] for i in range(len(better))]
    done = GraspBatch.concatenate([pose.without("score") for pose in poses])
    values = scored(problem, done).score
    score = torch.tensor([
        float(holding_score(values[i : i + 1], replace(known_of.rows(torch.tensor([i])), stable=good[i : i + 1])))
        for i in range(len(better))])
    best = sorted(range(len(better)), key=lambda row: -float(score[row]))[:keep]
    best = [row for row in best if float(score[row].sigmoid()) >= 0.1]
    chosen = done.replace(score=score)[torch.tensor(best, dtype=torch.long)]
    return ease(problem, chosen), [passed[better[row]] for row in best], len(passed)


@pytest.mark.parametrize("problem", [WHOLE, ON_TABLE], ids=["free", "on a table"])
def test_the_chain_is_its_stages_one_after_the_other(problem: GraspProblem) -> None:
    made = candidates(problem)
    done = finish(problem, made, FinishConfig(least_confidence=0.1), keep=3)
    expected, rows, passed = naive(problem, made, 3)
    same(done.grasps, expected)
    assert done.proposed.origin == tuple(f"start 0.{row}" for row in rows)
    assert torch.equal(done.proposed.grasps.joints, made.grasps.joints[rows])
    assert torch.equal(done.proposed.points, made.points[rows])
    assert done.made == 18
    assert len(done.refined) == passed
    assert sum(done.dropped.values()) == done.made - passed
    assert (passed < 16) == (problem is ON_TABLE)
    assert done.dropped == Counter({TURNED: 2}) + count_violations(problem, refine(problem, made.grasps))


def test_stages_that_are_none_are_left_out() -> None:
    made = candidates(WHOLE)
    nothing = finish(WHOLE, made, FinishConfig.nothing(), keep=16)
    whole = scored(WHOLE, complete(WHOLE, made.grasps))
    same(nothing.grasps, whole.sorted_by_score())
    assert nothing.seconds["settle"] == 0
    refined = finish(WHOLE, made, FinishConfig(settle=None), keep=16)
    same(refined.pool, scored(WHOLE, refine(WHOLE, made.grasps)))
    same(refined.pool, refined.refined)
    steps = finish(WHOLE, made, FinishConfig(refine=RefineConfig(steps=3), settle=None), keep=16)
    same(steps.pool, scored(WHOLE, refine(WHOLE, made.grasps, RefineConfig(steps=3))))
    bare = GraspProblem(dataclasses.replace(HAND, description=None), CAN)
    expected = holding_score(refined.pool.score, Evidence.none(16, CAN.mass))
    same(finish(bare, made, keep=3).pool, refined.pool.replace(score=expected))


def test_fingers_leave_room_last() -> None:
    """The pool, its scores and what is compared are of fingers that touch; what is given away leaves room."""
    made, settle = candidates(SEEN), SettleConfig(share=0.25)
    done = finish(SEEN, made, FinishConfig(settle=settle), keep=4)
    touching = finish(SEEN, made, FinishConfig(settle=settle, weigh=None, ease=None), keep=4)
    same(done.pool, touching.pool)
    same(touching.grasps, done.pool.sorted_by_score()[:4])
    same(done.grasps.replace(payload=touching.grasps.payload), ease(SEEN, touching.grasps))
    assert not torch.equal(done.grasps.joints, touching.grasps.joints)
    wide = finish(SEEN, made, FinishConfig(settle=settle, weigh=None, ease=EasingConfig(clearance=0.02)), keep=4)
    same(wide.grasps, ease(SEEN, touching.grasps, EasingConfig(clearance=0.02)))


def test_half_as_many_again_are_settled_as_are_wanted_or_their_share() -> None:
    made = candidates(WHOLE, 8)
    for share, keep, count in ((0.5, 1, 4), (0.5, 4, 6), (0.5, 20, 8), (0.25, 1, 2), (1.0, 1, 8)):
        done = finish(WHOLE, made, FinishConfig(settle=SettleConfig(share=share)), keep)
        assert len(done.pool) == len(done.candidates) == count
        assert len(done.rows) <= min(keep, count)
        assert len(done.refined) == 8


def test_rivals_stay_in_the_choice() -> None:
    config = FinishConfig(settle=None)
    parts = [candidates(WHOLE, 6, seed) for seed in (1, 2, 3)]
    done = None
    for part in parts:
        done = finish(WHOLE, part, config, 4, done)
    assert done is not None
    alone = [finish(WHOLE, part, config, 4) for part in parts]
    together = GraspBatch.concatenate([one.pool for one in alone])
    same(done.pool, together)
    same(done.grasps, together.sorted_by_score()[:4])
    assert len({name.split(".")[0] for name in done.proposed.origin}) > 1, "of several rounds"
    names = [name for part in parts for name in part.origin]
    assert done.proposed.origin == tuple(names[row] for row in (-together.score).argsort(stable=True)[:4])
    assert done.made == 3 * 8
    assert done.dropped == {TURNED: 6}
    same(done.refined, alone[-1].refined)
    assert set(done.seconds) == {"refine", "rank", "settle"}
    first = finish(WHOLE, parts[0], config, 4)
    assert finish(WHOLE, parts[1], config, 4, first).seconds["refine"] > first.seconds["refine"] > 0


def test_of_equal_scores_the_one_that_was_proposed_first_is_kept() -> None:
    made = candidates(WHOLE, 3)
    twice = Candidates.concatenate([made, replace(made, origin=("late",) * 3)])
    done = finish(WHOLE, twice, FinishConfig.nothing(), keep=3)
    assert done.proposed.origin[0].startswith("start")
    assert done.proposed.origin[1] == "late"


def test_what_is_not_trusted_enough_is_not_returned() -> None:
    made = candidates(WHOLE, 8)
    every = finish(WHOLE, made, FinishConfig(least_confidence=0.0, settle=SettleConfig(share=1.0)), keep=8)
    confidence = every.grasps.confidence
    least = float(confidence[3:5].mean())
    some = finish(WHOLE, made, FinishConfig(least_confidence=least, settle=SettleConfig(share=1.0)), keep=8)
    assert len(every.grasps) == 8
    same(some.grasps, every.grasps[:4])
    same(some.pool, every.pool)
    assert some.proposed.origin == every.proposed.origin[:4]
    assert sum(some.doubted.values()) == 4
    assert some.doubted == Counter(why for why, kept in zip(some.doubts, some.trusted.tolist(), strict=True) if not kept)
    assert not every.doubted
    later = finish(WHOLE, candidates(WHOLE, 4, 2), some.config, 8, some)
    assert later.doubts[:8] == some.doubts
    assert len(later.doubts) == len(later.pool)


@pytest.mark.parametrize("least", [-0.1, 1.0, math.nan])
def test_a_least_confidence_is_a_probability_below_one(least: float) -> None:
    with pytest.raises(OptionError, match=r"least_confidence is .*give a probability"):
        FinishConfig(least_confidence=least)
    with pytest.raises(OptionError, match=r"least_confidence is .*give a probability"):
        GraspRequest(least_confidence=least)


def test_what_is_lacking_is_counted_by_score() -> None:
    done = finish(WHOLE, candidates(WHOLE, 6), FinishConfig.nothing(), keep=4)
    best = done.grasps.score.tolist()
    assert done.lacking(best[0]) == 4
    assert done.lacking(best[1]) == 3
    assert done.lacking(-torch.inf) == 0
    assert finish(WHOLE, candidates(WHOLE, 2), FinishConfig.nothing(), keep=4).lacking(-torch.inf) == 2


def test_constraints_that_let_nothing_pass_leave_nothing() -> None:
    made, far = candidates(ON_TABLE, 4), FinishConfig(admission=AdmissionConfig(least_clearance=9.0))
    first = finish(ON_TABLE, made, far, 2)
    assert (len(first.pool), len(first.grasps), first.made, first.dropped.total()) == (0, 0, 6, 6)
    other = finish(ON_TABLE, candidates(ON_TABLE, 4, 1), FinishConfig(settle=None), 2, first)
    assert other.made == 12
    assert len(other.pool) == 12 - other.dropped.total()
