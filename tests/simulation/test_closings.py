"""A closing that a scene has seen before is not simulated again, and ends bit for bit where it ended."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import complete
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation import rollout as module
from dro_grasp.simulation.protocols import CARRY, STRICT, Protocol
from dro_grasp.simulation.rollout import Conditions, Rollout
from dro_grasp.simulation.scene import build_scene
from dro_grasp.simulation.worlds import STATE, ProcessorWorlds
from tests.helpers.claw import power_grasp


@pytest.fixture(scope="module")
def grasps(hand: Hand, obj: ObjectModel) -> GraspBatch:
    """Three grasps that press more and more."""
    made = complete(hand, power_grasp(hand, obj, 3), torch.zeros(3))
    return made.replace(squeeze_joints=made.joints + torch.tensor([[0.3], [0.6], [1.0]]) * (made.squeeze_joints - made.joints))


@pytest.fixture
def stepped(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many simulations took steps, call by call."""
    counts, step = [], ProcessorWorlds.step

    def noted(worlds: ProcessorWorlds, rows: np.ndarray, count: int) -> None:
        counts.append(len(rows))
        step(worlds, rows, count)

    monkeypatch.setattr(ProcessorWorlds, "step", noted)
    return counts


@pytest.mark.parametrize("rules", [CARRY, STRICT], ids=lambda rules: rules.name)
def test_it_ends_where_it_ended_and_goes_on_as_it_went_on(
    rules: Protocol, hand: Hand, obj: ObjectModel, grasps: GraspBatch, stepped: list[int]
) -> None:
    def run(scene: module.TrialScene, rows: list[int]) -> list[np.ndarray]:
        rollout = Rollout(scene, grasps[rows], 1)
        closed = rollout.close()
        ends = [np.array(rollout.batch.bind(name)) for name in (*STATE, "ctrl")]
        displacement, rotation, _ = rollout.push(closed, closed.stable)
        return [*ends, displacement, rotation]

    scene = build_scene(hand, obj, rules)
    run(scene, [0, 2])
    stepped.clear()
    found = run(scene, [2, 1, 0])
    assert set(stepped[:20 if rules.gradual else 1]) == {1}, "the two that are known are not simulated"
    for again, anew in zip(found, run(build_scene(hand, obj, rules), [2, 1, 0]), strict=True):
        np.testing.assert_array_equal(again, anew)


def heavier(rollout: Rollout) -> None:
    rollout.make_heavy(2 * rollout.mass)


def elsewhere(rollout: Rollout) -> None:
    rollout.qpos[:, rollout.scene.object_qpos.start] += 1e-9


def aimed(rollout: Rollout) -> None:
    rollout.targets[-1] = rollout.targets[-1] + 1e-6


@pytest.mark.parametrize("change", [heavier, elsewhere, aimed])
def test_a_closing_that_differs_in_anything_is_simulated(
    change: Callable[[Rollout], None], hand: Hand, obj: ObjectModel, grasps: GraspBatch, stepped: list[int]
) -> None:
    scene = build_scene(hand, obj, CARRY)
    Rollout(scene, grasps, 1).close()
    stepped.clear()
    other = Rollout(scene, grasps, 1)
    change(other)
    other.close()
    assert set(stepped) == {3}


def test_neither_are_closings_under_other_conditions_or_with_frames_known(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, stepped: list[int]
) -> None:
    scene, none, one = build_scene(hand, obj, CARRY), np.zeros((3, 3)), np.ones(3)
    Rollout(scene, grasps, 1, conditions=Conditions(none, none, 0.5 * one, one, one)).close()
    recorded = Rollout(scene, grasps, 1, stride=50)
    recorded.close()
    assert len(recorded.frames) > 20
    assert set(stepped) == {3}
    assert not scene.closings


def test_a_scene_keeps_a_limited_number(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "CLOSINGS", 4)
    scene = build_scene(hand, obj, CARRY)
    Rollout(scene, grasps, 1).close()
    assert len(scene.closings) == 3
    Rollout(scene, grasps.replace(squeeze_joints=grasps.joints), 1).close()
    assert len(scene.closings) == 3
