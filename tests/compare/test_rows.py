"""Rows of the benchmark against numbers worked out by hand."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from dro_grasp.cli.benchmark import cells
from dro_grasp.compare.methods import Method
from dro_grasp.compare.metrics import wilson_interval
from dro_grasp.compare.rows import EvaluatedGrasps, Row, average, hand_row
from dro_grasp.compare.stages import BEST, EQUAL_TIME, RANKED, RAW, REFINED, RETURNED, STAGES, BenchmarkConfig, benchmark
from dro_grasp.errors import GraspFileError, OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimize.synthesis import PROVENANCE, SynthesisConfig, synthesize
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.controls import StartSource
from dro_grasp.predict.sources.own import FileSource
from dro_grasp.predict.sources.source import Progress, Source
from dro_grasp.predict.stages import refine
from dro_grasp.simulation.protocols import Protocol, changed, protocol
from dro_grasp.simulation.trial import simulate
from tests.helpers.loaded_hands import loaded_hand

STRICT = "strict/1"
LENIENT = Protocol("lenient", max_displacement=math.inf)
"""Whatever touches the object in the end holds it."""
HELD = LENIENT.label
HAND, CAN = loaded_hand("gripper3"), load_object("can")


class Sparing(StartSource):
    """Proposes the same two grasps, however many are asked for."""

    name = "sparing"

    def __init__(self, two: GraspBatch) -> None:
        self.two = two

    def propose(self, problem: GraspProblem, num: int, seed: int, progress: Progress | None = None) -> GraspBatch:
        return self.two


class Lazy(StartSource):
    """Proposes none."""

    name = "lazy"

    def propose(self, problem: GraspProblem, num: int, seed: int, progress: Progress | None = None) -> GraspBatch:
        return super().propose(problem, 1, seed)[:0]


@pytest.fixture(scope="module")
def predictor(weights: str) -> GraspPredictor:
    return GraspPredictor(weights)


@pytest.fixture(scope="module")
def good() -> GraspBatch:
    """Grasps that hold."""
    made = synthesize(HAND, CAN, 24, 1, SynthesisConfig(batch_size=24, steps=20))
    grasps = refine(GraspProblem(HAND, CAN), made).poses_only()
    return grasps[simulate(HAND, CAN, grasps, "strict").success]


def measured(
    source: Source, predictor: GraspPredictor, *stages: str, num: int = 16, rules: Protocol = LENIENT
) -> dict[str, Row]:
    config, method = BenchmarkConfig(num=num, stages=stages, protocols=(rules,)), Method(source, predictor)
    return {row.stage: row for row in benchmark([HAND], [CAN], [method], config)}


def test_what_a_method_does_not_return_counts_as_a_failure(predictor: GraspPredictor, good: GraspBatch) -> None:
    rows = measured(Sparing(good[:2]), predictor, RAW, RANKED, REFINED, BEST, "refined, top 1", RETURNED, EQUAL_TIME)
    asked = {RAW: 16, RANKED: 4, REFINED: 16, BEST: 4, "refined, top 1": 1, RETURNED: 4, EQUAL_TIME: 4}
    for stage, n in asked.items():
        row, there = rows[stage], min(n, 2)
        assert (row.asked, row.returned, row.held) == (n, there, {HELD: there}), stage
        assert row.success[HELD] == (there / n, *wilson_interval(there, n)), stage
        assert row.to_dict()["num"] == n
        assert cells(row)[3] == (f"{n} ({there} returned)" if there < n else n)


def test_a_method_that_returns_nothing_fails_everything(predictor: GraspPredictor) -> None:
    for stage, row in measured(Lazy(), predictor, *STAGES, RETURNED, num=8, rules=protocol("strict")).items():
        assert (row.returned, row.held) == (0, {STRICT: 0}), stage
        assert row.success[STRICT] == (0.0, *wilson_interval(0, row.asked)), stage


def test_stored_grasps_are_of_the_request_that_they_answer(
    tmp_path: Path, predictor: GraspPredictor, good: GraspBatch
) -> None:
    problem = GraspProblem(HAND, CAN)
    grasps = good[:3]
    grasps.save(tmp_path / "unknown.parquet")
    grasps.with_asked(12).save(tmp_path / "answer.parquet")
    row = measured(FileSource(tmp_path / "unknown.parquet"), predictor, RAW)[RAW]
    assert (row.asked, row.returned) == (3, 3)
    answer = FileSource(tmp_path / "answer.parquet")
    row = measured(answer, predictor, RAW)[RAW]
    assert (row.asked, row.returned, row.held[HELD]) == (12, 3, 3)
    # Of a part of the request, a part of the grasps.
    few = [len(answer.propose(problem, 4, seed)) for seed in range(40)]
    assert 0.6 < sum(few) / 40 < 1.4
    assert measured(answer, predictor, RAW, num=4)[RAW].asked == 4


def test_a_stored_grasp_is_returned_once(tmp_path: Path, predictor: GraspPredictor) -> None:
    """A file that holds fewer than are asked for is asked again, and has no others."""
    StartSource().propose(GraspProblem(HAND, CAN), 5, 0).save(tmp_path / "few.parquet")
    row = measured(FileSource(tmp_path / "few.parquet"), predictor, RETURNED, num=32)[RETURNED]
    assert (row.asked, row.returned, row.candidates) == (5, 5, 5)


def test_a_file_that_lacks_an_object_is_refused_before_anything_is_measured(
    tmp_path: Path, predictor: GraspPredictor, good: GraspBatch
) -> None:
    good[:2].save(tmp_path / "cans.parquet")
    methods, done = [Method(StartSource(), predictor), Method(FileSource(tmp_path / "cans.parquet"), predictor)], []
    with pytest.raises(GraspFileError, match="'cans' holds no grasp of 'torus', but of can"):
        benchmark([HAND], [CAN, load_object("torus")], methods, BenchmarkConfig(num=4, stages=(RAW,), protocols=(LENIENT,)),
                  lambda *pairs: done.append(pairs))
    assert not done


def test_the_optimisers_share_counts_grasps_of_every_version(tmp_path: Path, predictor: GraspPredictor) -> None:
    made = StartSource().propose(GraspProblem(HAND, CAN), 4, 0)
    made.replace(provenance=("dro-grasp 0.1.0, synthesis 1", PROVENANCE, "network 'multi'", "start")).save(
        tmp_path / "stored.parquet")
    assert measured(FileSource(tmp_path / "stored.parquet"), predictor, RAW)[RAW].optimised == 0.5


def test_a_method_that_returns_too_many_is_refused(predictor: GraspPredictor, good: GraspBatch) -> None:
    with pytest.raises(OptionError, match="2 grasps of a request for 1"):
        measured(Sparing(good[:2]), predictor, RAW, num=1)


def test_two_changes_of_one_protocol_have_two_columns(predictor: GraspPredictor) -> None:
    rules = (changed("strict", mass_factor=0.5), changed("strict", mass_factor=2))
    config = BenchmarkConfig(num=1, stages=(RAW,), protocols=rules)
    (row,) = benchmark([HAND], [CAN], [Method("start", predictor)], config)
    assert list(row.success) == list(row.fingers) == ["strict+mass_factor=0.5/1", "strict+mass_factor=2/1"]


def test_two_methods_of_one_name_are_refused(predictor: GraspPredictor, good: GraspBatch) -> None:
    """Their grasps would share a row."""
    config, twice = BenchmarkConfig(num=1, stages=(RAW,), protocols=(LENIENT,)), [Method(Sparing(good), predictor)] * 2
    with pytest.raises(OptionError, match="two methods are called 'sparing'"):
        benchmark([HAND], [CAN], twice, config)


def row(hand: str, held: int, asked: int) -> Row:
    share = (held / asked if asked else float("nan"), *wilson_interval(held, asked))
    return Row("auto", RAW, hand, asked, held, {STRICT: held}, {STRICT: share}, 0.0, 0.0, 0.0, {}, {STRICT: (1.0, 1.0)}, {},
               {}, 1.0, 0.0, {})


def test_the_average_of_hands_with_other_numbers_has_an_interval_around_it() -> None:
    """Hands 4 of 4 and 8 of 16: the mean is 0.75, not 12 of 20. Its variance is p (1 - p) (1/4 + 1/16) / 4, which is that of
    12.8 grasps, so its interval is Wilson's of 9.6 of 12.8."""
    whole = average([row("a", 4, 4), row("b", 8, 16)])
    assert (whole.asked, whole.returned, whole.held) == (20, 12, {STRICT: 12})
    assert whole.success[STRICT] == pytest.approx((0.75, 0.4764, 0.9082), abs=1e-4)


def test_the_average_of_hands_with_one_number_has_the_interval_of_all() -> None:
    whole = average([row("a", 3, 8), row("b", 8, 8)])
    assert whole.success[STRICT] == pytest.approx((11 / 16, *wilson_interval(11, 16)))
    alone = average([row("a", 3, 8), row("b", 0, 0)])
    assert alone.success[STRICT] == pytest.approx((3 / 8, *wilson_interval(3, 8)))


@pytest.mark.usefixtures("as_users_have_it")
@pytest.mark.parametrize("name", ["carry", "dexgraspbench", "dro"])
def test_every_force_counts_where_each_starts_anew(name: str) -> None:
    grasps = GraspBatch.create(HAND, CAN, torch.eye(4).repeat(3, 1, 1), HAND.canonical_joints().repeat(3, 1))
    moved = torch.tensor([[4.0, 1, 1, 1, 1, 2], [1, 1, 8, 1, 1, 6], [99, 99, 99, 99, 99, 99]]) / 1000
    trial = SimpleNamespace(success=torch.tensor([True, True, False]), displacement=moved, rotation=10 * moved,
                            fingers_in_contact=torch.ones(3), robustness=torch.full((3,), torch.nan))
    row = hand_row("a", RAW, [EvaluatedGrasps(grasps, (trial,), {}, 3, 3)], (protocol(name),))  # type: ignore[arg-type]
    expected = 0.006 if protocol(name).reset else 0.004
    assert (row.displacement, row.rotation) == pytest.approx((expected, 10 * expected))
