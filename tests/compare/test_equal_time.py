"""Equal time, on a clock that goes on by what each candidate is said to cost."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import pytest
import torch

from dro_grasp.compare.methods import Method
from dro_grasp.compare.stages import Returned, best_within, equal_time, finished_maker
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.objects.catalogue import load_object
from dro_grasp.predict.config import PredictorConfig
from dro_grasp.predict.finish import FinishConfig, finish
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.tiny_bundle import made_up_grasps
from tests.helpers.toy_hand import toy_hand
from tests.helpers.weights import untrained_weights

HAND = toy_hand()
NUM, KEEP, COST = 16, 4, 0.5  # the first source takes 8 s for 16 candidates


@dataclass
class Clock:
    """Fake seconds."""

    now: float = 100.0

    def __call__(self) -> float:
        return self.now


@dataclass
class Maker:
    """Makes grasps with random scores, and lets the clock go on."""

    clock: Clock
    cost: float
    """Of each candidate [s]."""
    start: float = 0.0
    """Of each call [s]."""
    preparation: float = 0.0
    """Of the first call [s]."""
    lost: float = 0.0
    """Share of the candidates that is lost."""
    calls: list[tuple[int, int]] = field(default_factory=list)
    """Number and seed of each."""
    scores: list[torch.Tensor] = field(default_factory=list)
    """Of the grasps of each call."""

    def __call__(self, num: int, seed: int) -> GraspBatch:
        self.clock.now += self.cost * num + self.start + (0.0 if self.calls else self.preparation)
        self.calls.append((num, seed))
        self.scores.append(torch.rand(round(num * (1 - self.lost)), generator=torch.Generator().manual_seed(seed)))
        assert torch.get_num_threads() == 1
        return made_up_grasps(HAND, count=len(self.scores[-1])).replace(score=self.scores[-1])


def run(**control: float) -> tuple[Maker, Maker, dict[str, Returned]]:
    """Maker of the first source, of the control, and what both return."""
    clock = Clock()
    first, other = Maker(clock, COST, preparation=40.0), Maker(clock, **control)
    return first, other, equal_time({"first": first, "other": other}, NUM, KEEP, 5, clock)


@pytest.mark.parametrize(("cost", "candidates"), [(0.125, 64), (0.5, 16), (0.75, 10), (1.0, 8), (2.0, 4), (4.0, 4)])
def test_a_cheap_control_gets_more_candidates_and_a_dear_one_fewer(cost: float, candidates: int) -> None:
    first, other, found = run(cost=cost)
    assert found["first"].candidates == NUM
    assert found["first"].seconds == NUM * COST, "what is prepared once is not counted"
    assert first.calls[-1] == (NUM, 5)
    assert found["other"].candidates == candidates
    assert found["other"].seconds == candidates * cost, "also where it is more than the time allows"
    assert [num for num, _ in other.calls] == [KEEP, candidates], "a rough measure, then all of them at once"


def test_a_rough_measure_that_is_wrong_is_corrected() -> None:
    """The preparation hides what a candidate costs, so the first round is the smallest; the second uses what is left."""
    _, other, found = run(cost=0.125, preparation=64.0)
    assert [num for num, _ in other.calls] == [KEEP, KEEP, 60]
    assert found["other"].candidates == 64
    assert found["other"].seconds == NUM * COST


@pytest.mark.parametrize("start", [0.25, 0.5, 1.0])
def test_calls_that_cost_something_each_use_the_time_and_exceed_it_by_one_start_at_most(start: float) -> None:
    _, other, found = run(cost=0.0625, start=start)
    spent = found["other"].seconds
    assert len({seed for _, seed in other.calls}) == len(other.calls) > 2, "each round has other random numbers"
    assert spent == sum(num * 0.0625 + start for num, _ in other.calls[1:])
    assert 0.9 * NUM * COST - start <= spent <= NUM * COST + start


@pytest.mark.parametrize("lost", [0.0, 0.5])
def test_the_best_of_all_rounds_are_returned_best_first(lost: float) -> None:
    _, other, found = run(cost=0.0625, start=0.5, lost=lost)
    every = sorted((float(s) for scores in other.scores[1:] for s in scores), reverse=True)
    assert found["other"].grasps.score.tolist() == pytest.approx(every[:KEEP])
    assert found["other"].candidates == sum(num for num, _ in other.calls[1:]), "lost ones have cost their time"


def test_a_control_that_loses_too_many_returns_what_it_has() -> None:
    _, _, found = run(cost=2.0, lost=0.75)
    assert len(found["other"].grasps) == 1
    assert found["other"].candidates == 4
    _, _, found = run(cost=2.0, lost=1.0)
    assert len(found["other"].grasps) == 0


def test_threads_come_back() -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        run(cost=1.0)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_every_methods_candidates_are_finished_as_its_predictor_is_told(tmp_path: Path) -> None:
    problem = GraspProblem(loaded_hand("gripper3"), load_object("can"))
    weights = str(untrained_weights(tmp_path))
    for config in (FinishConfig(), FinishConfig.nothing()):
        method = Method("start", GraspPredictor(weights, config=PredictorConfig(finish=config)))
        made = finished_maker(problem, method, 2)(5, 1)
        expected = finish(problem, method.propose(problem, 5, 1), config, 2)
        assert len(made) == (3 if config.settle is not None else 5)
        assert torch.equal(made.score, expected.pool.score)
        assert torch.equal(made.joints, expected.pool.joints)


def test_a_grasp_that_comes_again_counts_once() -> None:
    clock, stored = Clock(), made_up_grasps(HAND, "sphere", 3, score=torch.arange(3.0))

    def make(num: int, seed: int) -> GraspBatch:
        clock.now += COST * num
        return stored[torch.arange(num) % 3]

    found = best_within(8.0, make, KEEP, 0, clock)
    assert sorted(found.grasps.score.tolist()) == [0.0, 1.0, 2.0]
