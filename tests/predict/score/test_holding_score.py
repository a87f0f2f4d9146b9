"""The score of a settled grasp rises with what holds it, and knows failures that geometry does not see."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from dro_grasp.compare.metrics import roc_area
from dro_grasp.errors import WeightsError
from dro_grasp.network.checkpoints import save_weights
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimize.synthesis import synthesize
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.score.holding import (
    FEATURES,
    SHIPPED_HOLDING,
    Evidence,
    HoldingScore,
    gives_way,
    holding_features,
    holding_score,
    load_holding_score,
    shipped_holding_score,
)
from dro_grasp.predict.stages import refine, scored
from dro_grasp.simulation.grasp_state import GraspState
from dro_grasp.simulation.trial import simulate
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.one_object import settle_grasps

FIRM = {"shift": 0.001, "turn": 0.02, "speed": 1e-4, "spin": 1e-3, "pierced": 0.0,
        "contacts": 9.0, "links": 5.0, "pressure": 20.0, "slip": 0.5}
"""A grasp that holds."""


def held(gave: tuple[float, float] = (0.001, 0.02), worst: float = 0.4, moved: float = 0.002, stable: bool = True,
         effort: float = 0.4, depth: float = 0.001, mass: float = 0.3, **changes: float) -> Evidence:
    values = {k: torch.tensor([v]) for k, v in (FIRM | changes).items()}
    state = GraspState(**values, unanswered=torch.tensor([[worst, 0.8 * worst]]), gave=torch.tensor([gave]))
    numbers = (torch.tensor([x]) for x in (moved, stable, depth, effort, mass))
    return Evidence(*numbers, state)


def score(of: float, known: Evidence) -> float:
    return float(holding_score(torch.tensor([of]), known))


@pytest.mark.parametrize("worse", [
    {"speed": 0.05, "spin": 1.0, "gave": (0.1, 3.0)}, {"shift": 0.018, "turn": 0.4, "gave": (0.03, 0.5)}, {"mass": 3.0},
    {"gave": (0.1, 3.0)}, {"depth": 0.006, "stable": False},
    {"contacts": 0.0, "links": 0.0, "pressure": 0.0, "slip": 3.0, "worst": 3.0, "gave": (0.1, 3.0)},
    {"stable": False, "moved": 0.04},
])
def test_what_holds_less_scores_less(worse: dict[str, Any]) -> None:
    assert score(1.0, held(**worse)) < score(1.0, held()) - 0.1


def test_the_ranking_networks_score_counts() -> None:
    assert score(-2.0, held()) < score(2.0, held()) - 0.2
    assert holding_features(torch.tensor([1.0]), held()).shape == (1, FEATURES)


def test_what_is_not_known_counts_as_usual() -> None:
    """A grasp of which nothing is known stands where the training grasps stand in the mean, flags aside."""
    model = shipped_holding_score()
    features = holding_features(torch.tensor([1.0]), Evidence.none(1, 0.3))
    assert features.isnan().any()
    filled = torch.where(features.isnan(), model.mean, features)
    torch.testing.assert_close(model(features), model(filled))
    low, high = (float(holding_score(torch.tensor([s]), Evidence.none(1, 0.3))) for s in (-3.0, 3.0))
    assert low < high < score(3.0, held())


def test_calibration_keeps_the_order_and_the_offset() -> None:
    model = HoldingScore(2, 4)
    model.calibration = torch.tensor([-0.5, 2.0, 0.25])
    rank = torch.tensor([-3.0, -1.0, 0.0, 2.0])
    torch.testing.assert_close(model.calibrated(rank), torch.tensor([-6.5, -2.5, -0.5, 0.0]))
    shipped = shipped_holding_score()
    found = shipped.calibrated(torch.linspace(-8, 8, 50))
    assert bool((found.diff() >= 0).all()), "monotone"
    assert float(found[-1] - found[0]) > 1
    assert float(shipped.weight.sum()) == pytest.approx(1.0)


def test_rows_that_closed_twice_are_filled_in() -> None:
    one, none = held(), Evidence.none(3, 0.2)
    known = none.known(torch.tensor([1]), one.depth, one.effort, one.state)
    assert known.state.shift.isnan().tolist() == [True, False, True]
    assert known.state.gave[1].tolist() == pytest.approx([0.001, 0.02])
    assert known.rows(torch.tensor([1])).state.unanswered.shape == (1, 2)
    assert none.state.shift.isnan().all(), "the other one stays"


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
    grasps, rows, known, _ = settle_grasps(problem, refine(problem, synthesize(hand, obj, 128, 5)))
    grasps = scored(problem, grasps[rows])
    holds = simulate(hand, obj, grasps, "carry").success
    assert 20 < int(holds.sum()) < len(holds) - 20
    assert roc_area(holding_score(grasps.score, known.rows(rows)), holds) > max(0.7, roc_area(grasps.score, holds))


def test_how_far_what_gives_way_would_have_gone_plays_no_role() -> None:
    motions = (0.021, 0.01), (0.3, 2.0), (0.019, 0.2)
    one, other, firm = (holding_features(torch.tensor([1.0]), held(gave=gave)) for gave in motions)
    torch.testing.assert_close(one, other)
    assert not torch.equal(one, firm)
    states = held(gave=(0.019, 0.2)).state, held(gave=(0.019, 0.3)).state, Evidence.none(1, 0.3).state
    assert [bool(gives_way(state)) for state in states] == [False, True, False]
