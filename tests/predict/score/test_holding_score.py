"""The score of a settled grasp rises with what holds it, and knows failures that geometry does not see."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from dro_grasp.compare.metrics import roc_area
from dro_grasp.errors import WeightsError
from dro_grasp.network.checkpoints import save_weights
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimize.synthesis import synthesize
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.score.score import HOLDING_FEATURES, SHIPPED_HOLDING, holding_features, holding_score, load_holding_score
from dro_grasp.predict.settling import settle_grasps
from dro_grasp.predict.stages import refine, scored
from dro_grasp.simulation.grasp_state import GraspState
from dro_grasp.simulation.trial import simulate
from tests.helpers.loaded_hands import loaded_hand

FIRM = {"shift": 0.001, "turn": 0.02, "speed": 1e-4, "spin": 1e-3, "contacts": 9.0, "links": 5.0, "pressure": 20.0, "slip": 0.5}
"""A grasp that holds."""


def held(**changes: float) -> GraspState:
    values = FIRM | changes
    worst = values.pop("worst", 0.4)
    pairs = {"unanswered": torch.tensor([[worst, 0.8 * worst]]), "gave": torch.zeros(1, 2)}
    return GraspState(**{k: torch.tensor([v]) for k, v in values.items()}, **pairs)


@pytest.mark.parametrize("worse", [
    {"speed": 0.05, "spin": 1.0}, {"contacts": 2.0, "links": 2.0}, {"shift": 0.018, "turn": 0.4}, {"worst": 1.2},
    {"contacts": 0.0, "links": 0.0, "pressure": 0.0, "slip": 3.0, "worst": 3.0},
])
def test_what_holds_less_scores_less(worse: dict[str, float]) -> None:
    score = torch.tensor([1.0])
    assert holding_score(score, held(**worse)) < holding_score(score, held()) - 0.1


def test_the_ranking_networks_score_counts() -> None:
    low, high = (float(holding_score(torch.tensor([s]), held())) for s in (-2.0, 2.0))
    assert low < high - 0.5
    assert holding_features(torch.tensor([1.0]), held()).shape == (1, HOLDING_FEATURES)


@pytest.mark.parametrize("content", ["missing", "cut short", "another network"])
def test_a_file_that_holds_no_such_score_is_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "score.safetensors"
    if content == "cut short":
        path.write_bytes(SHIPPED_HOLDING.read_bytes()[:200])
    elif content == "another network":
        save_weights(torch.nn.Linear(2, 1), path)
    with pytest.raises(WeightsError, match=r"score.safetensors cannot be read"):
        load_holding_score(path)


def test_a_file_with_a_number_that_is_none_is_refused(tmp_path: Path) -> None:
    broken = load_holding_score(SHIPPED_HOLDING)
    with torch.no_grad():
        broken.layers[0].bias[0] = torch.nan
    save_weights(broken, tmp_path / "score.safetensors")
    with pytest.raises(WeightsError, match=r"'layers.0.bias' holds NaN"):
        load_holding_score(tmp_path / "score.safetensors")


@pytest.mark.slow
def test_it_tells_better_than_geometry_alone_which_settled_grasps_hold() -> None:
    hand, obj = loaded_hand("gripper3"), load_object("hammer")
    problem = GraspProblem(hand, obj)
    grasps, rows, state = settle_grasps(problem, refine(problem, synthesize(hand, obj, 256, 5)))
    grasps = scored(problem, grasps[rows])
    holds = simulate(hand, obj, grasps, "dexgraspbench").success
    assert 30 < int(holds.sum()) < len(holds) - 30
    assert roc_area(holding_score(grasps.score, state), holds) > max(0.7, roc_area(grasps.score, holds))
