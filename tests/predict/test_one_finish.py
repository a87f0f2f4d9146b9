"""A source of yours by one entry, everywhere: what it proposes is finished in one way, whoever asks for it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from dro_grasp.arm.planning.candidates import grasps_in_world
from dro_grasp.cli.main import main
from dro_grasp.compare.methods import Method
from dro_grasp.compare.stages import RETURNED, BenchmarkConfig, benchmark, pair_seed
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimize.refinement import RefineConfig
from dro_grasp.predict.admission import AdmissionConfig
from dro_grasp.predict.config import GraspRequest, PredictorConfig, RetryConfig
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.finish import FinishConfig, finish
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.settling import SettleConfig
from dro_grasp.predict.sources.controls import palm_facing_starts
from dro_grasp.predict.sources.registry import SOURCES, register_source
from dro_grasp.predict.sources.source import Progress, Source, ask
from dro_grasp.simulation.protocols import protocol
from dro_grasp.simulation.trial import simulate
from tests.helpers.loaded_hands import loaded_hand

HAND, CAN = loaded_hand("gripper3"), load_object("can")
PROBLEM = GraspProblem(HAND, CAN)
FIELDS = ("T_object_wrist", "joints", "pregrasp_joints", "squeeze_joints", "score")
CHANGED = {
    "few steps": FinishConfig(refine=RefineConfig(steps=2)),
    "nothing settles": FinishConfig(settle=None),
    "none holds": FinishConfig(settle=SettleConfig(deepest=-1.0), least_confidence=0.0),
    "nothing": FinishConfig.nothing(),
}
"""Ways to finish that each change what comes out."""


class Theirs(Source):
    """A source that no module of the package knows."""

    name = "theirs"

    def propose(self, problem: GraspProblem, num: int, seed: int, progress: Progress | None = None) -> GraspBatch:
        return palm_facing_starts(problem.hand, problem.obj, num, seed)


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    register_source("theirs", Theirs)
    yield
    del SOURCES["theirs"]


def same(first: GraspBatch, second: GraspBatch) -> None:
    assert len(first) == len(second)
    for name in FIELDS:
        torch.testing.assert_close(getattr(first, name), getattr(second, name), rtol=1e-3, atol=1e-3)  # plan multiplies quickly


def finished(config: FinishConfig, num: int, seed: int, problem: GraspProblem = PROBLEM, each: int = 4) -> GraspBatch:
    """What has to come out: the source's candidates, finished."""
    return finish(problem, ask(Theirs(), problem, num * each, seed), config, num).grasps


@cache
def usual() -> GraspBatch:
    """What comes out as long as nobody asks for anything else."""
    return finished(FinishConfig(), 4, 7)


def generated(weights: str, folder: Path, *more: str) -> GraspBatch:
    path = folder / "generated.parquet"
    assert main(["generate", "--hand", "gripper3", "--object", "can", "--source", "theirs", "--weights", weights, "--num", "3",
                 "--seed", "5", "--output", str(path), "--json", *more]) == 0
    return GraspBatch.load(path)


def test_by_its_name_it_is_in_predict_generate_benchmark_and_plan(
    weights: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    predictor, expected = GraspPredictor(weights), finished(FinishConfig(), 3, 5, each=2)
    same(predictor.predict(HAND, CAN, 3, seed=5, candidates=2, source="theirs"), expected)
    same(generated(weights, tmp_path, "--candidates", "2"), expected)
    told = json.loads(capsys.readouterr().out)
    assert (told["origin"], told["candidates"]) == ({"theirs": 3}, 6)
    assert told["seconds"]["theirs"] > 0 == told["seconds"]["network"]
    request = GraspRequest(3, 5, candidates=2, source="theirs")
    same(grasps_in_world(predictor, HAND, CAN, np.eye(4), request, Constraints()), expected)
    assert main(["benchmark", "--methods", "theirs", "--weights", weights, "--hands", "gripper3", "--objects", "can", "--num",
                 "12", "--stages", "returned", "--protocols", "strict", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    assert (row["grasps"], row["stage"], row["asked"]) == ("theirs", "returned", 3)
    assert 8 <= row["candidates"] <= 12


@pytest.mark.parametrize("name", CHANGED)
def test_another_way_to_finish_changes_them_all_alike(weights: str, name: str) -> None:
    config, hand, can = CHANGED[name], HAND, CAN
    predictor = GraspPredictor(weights, config=PredictorConfig(finish=config, retry=RetryConfig(first=4)))
    expected = finished(config, 4, 7)
    assert not torch.equal(expected.score, usual().score)
    same(predictor.predict(hand, can, 4, seed=7, source="theirs"), expected)
    same(grasps_in_world(predictor, hand, can, np.eye(4), GraspRequest(4, 7, source="theirs"), Constraints()), expected)
    method = Method("theirs", predictor)
    same(method.predict(hand, can, 4, seed=7), expected)
    rules = BenchmarkConfig(num=16, stages=(RETURNED,), protocols=(protocol("strict"),))
    (row,) = benchmark([hand], [can], [method], rules)
    trial = simulate(hand, can, finished(config, 4, pair_seed(0, hand, can)), "strict")
    assert row.held == {"strict/1": int(trial.success.sum())}
    assert row.fingers["strict/1"][0] == pytest.approx(float(trial.fingers_in_contact.float().mean()) / 3)


def test_plan_and_generate_return_the_same_grasps_where_constraints_are_the_same(weights: str, tmp_path: Path) -> None:
    """The object stands elsewhere, turned about the vertical; the table is the one under it."""
    low = float(CAN.cloud[:, 2].min())
    made = generated(weights, tmp_path, "--table", str(low - 0.03), "--direction", "1", "0", "-0.5", "--protocol", "none")
    T = np.array([[0.0, -1.0, 0.0, 0.4], [1.0, 0.0, 0.0, -0.1], [0.0, 0.0, 1.0, 0.2], [0.0, 0.0, 0.0, 1.0]])
    wanted = Constraints(direction=(0.0, 1.0, -0.5), table=0.2 + low - 0.03)
    planned = grasps_in_world(GraspPredictor(weights), HAND, CAN, T, GraspRequest(3, 5, source="theirs"), wanted)
    assert len(made) > 0
    for name in ("joints", "pregrasp_joints", "squeeze_joints", "score"):
        torch.testing.assert_close(getattr(planned, name), getattr(made, name), rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(planned.T_object_wrist, torch.from_numpy(T).float() @ made.T_object_wrist, rtol=0, atol=1e-3)


def test_the_same_constraints_bind_it_everywhere(weights: str) -> None:
    """It knows nothing of a table; whoever asks, no hand comes near it."""
    config = FinishConfig(settle=None, admission=AdmissionConfig(least_clearance=0.01))
    predictor = GraspPredictor(weights, config=PredictorConfig(finish=config))
    table = Constraints(table=float(CAN.cloud[:, 2].min()) - 0.02)
    problem = GraspProblem(HAND, CAN, constraints=table)
    lowest = []
    for grasps in (predictor.predict(HAND, CAN, 4, seed=2, constraints=table, source="theirs"),
                   grasps_in_world(predictor, HAND, CAN, np.eye(4), GraspRequest(4, 2, source="theirs"), table),
                   Method("theirs", predictor).returned(problem, 4, 2).grasps):
        points = torch.stack([HAND.points(q, grasps.T_object_wrist) for q in (grasps.joints, grasps.squeeze_joints)])
        lowest.append(float(points[..., 2].min()) - float(table.table or 0.0))
    assert min(lowest) > 0.01
    assert max(lowest) - min(lowest) < 1e-3
