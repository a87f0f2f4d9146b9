"""The stages between proposal and trial: what they share, what they refuse, what they leave alone."""

from __future__ import annotations

import time
from dataclasses import replace

import pytest
import torch

from dro_grasp.energy.grasp_energy import EnergyConfig, GraspEnergy
from dro_grasp.errors import GraspFileError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimization.synthesis import SynthesisConfig, synthesize, synthesize_with
from dro_grasp.perception.partial_views import partial_view
from dro_grasp.predict import stages
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.stages import complete, eased, evaluate, optimise, rank, refine, scored
from dro_grasp.predict.stopwatch import Stopwatch
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.toy_hand import toy_hand

HAND, CAN = loaded_hand("gripper3"), load_object("can")
PROBLEM = GraspProblem(HAND, CAN)


@pytest.fixture(scope="module")
def grasps() -> GraspBatch:
    return synthesize(HAND, CAN, 6, 0, SynthesisConfig(batch_size=6, steps=20))


@pytest.mark.parametrize("stage", [complete, refine, scored, rank, evaluate])
def test_a_stage_refuses_grasps_of_another_hand(stage, grasps: GraspBatch) -> None:
    with pytest.raises(GraspFileError, match="these grasps are for hand 'gripper3'"):
        stage(GraspProblem(toy_hand(), CAN), grasps)


def test_weights_share_geometry_and_mean_what_a_fresh_energy_means(grasps: GraspBatch) -> None:
    configs = EnergyConfig(), EnergyConfig(penetration=500.0, hand_points=100)
    first, second = (PROBLEM.energy(config) for config in configs)
    assert first.candidates is second.candidates
    assert PROBLEM.energy(configs[0]) is first
    for config, shared in zip(configs, (first, second), strict=True):
        fresh = GraspEnergy.of_object(HAND, CAN, config)
        terms = [e(grasps.T_object_wrist, grasps.joints).terms for e in (shared, fresh)]
        assert torch.equal(*terms)


def test_stages_return_new_grasps_and_leave_the_given_ones(grasps: GraspBatch) -> None:
    before = grasps.T_object_wrist.clone()
    moved = refine(PROBLEM, grasps)
    assert torch.equal(grasps.T_object_wrist, before)
    assert not torch.equal(moved.T_object_wrist, before)
    assert bool(moved.states_closing.all())
    ranked = rank(PROBLEM, moved)
    assert ranked.score.tolist() == sorted(scored(PROBLEM, moved).score.tolist(), reverse=True)
    assert not moved.evaluated.any()
    assert bool(evaluate(PROBLEM, ranked[:2], workers=1).evaluated.all())


def test_fingers_leave_room_on_a_bare_cloud_where_the_constraints_let_them(grasps: GraspBatch) -> None:
    whole = complete(PROBLEM, grasps)
    assert eased(PROBLEM, whole) is whole, "a mesh is known"
    cloud = GraspProblem(HAND, partial_view(CAN, "cloud", 0))
    given = whole.replace(score=torch.arange(6.0))
    apart = eased(cloud, given)
    for name in ("T_object_wrist", "pregrasp_joints", "squeeze_joints", "score"):
        assert torch.equal(getattr(apart, name), getattr(given, name))
    clear = [CAN.distance_field.distances(HAND.points(g.joints, g.T_object_wrist))[0].amin(-1) for g in (given, apart)]
    assert float((clear[1] - clear[0]).max()) > 0.002
    assert float((clear[1] - clear[0]).min()) > -1e-4
    below = GraspProblem(HAND, cloud.obj, constraints=Constraints(cone=0.01, direction=(0.0, 0.0, 1.0)))
    assert torch.equal(eased(below, given).joints, given.joints), "none of these grasps is permitted"


def test_where_the_wider_room_is_forbidden_fingers_leave_that_of_a_surface_that_was_seen(
    grasps: GraspBatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = partial_view(PROBLEM.obj, "cloud", 0)
    plain, half = (GraspProblem(PROBLEM.hand, o) for o in (whole, replace(whole, seen=whole.cloud[whole.cloud[:, 0] > 0])))
    given = complete(plain, grasps)
    narrow, wide = eased(plain, given).joints, eased(half, given).joints
    other = (narrow != wide).any(1)
    assert bool(other.any())

    def all_but_the_wide(problem: GraspProblem, some: GraspBatch) -> torch.Tensor:
        return torch.tensor([not any(torch.equal(row, w) for w in wide[other]) for row in some.joints])

    monkeypatch.setattr(stages, "permitted", all_but_the_wide)
    torch.testing.assert_close(eased(half, given).joints, torch.where(other[:, None], narrow, wide))


def test_a_stopwatch_adds_up_and_lists_what_never_ran() -> None:
    watch = Stopwatch("slept", "never")
    for _ in range(2):
        with watch("slept"):
            time.sleep(0.01)
    assert watch.seconds["never"] == 0
    assert watch.seconds["slept"] >= 0.02


def test_optimised_candidates_are_those_of_lowest_energy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dro_grasp.predict.stages.STARTS_PER_CANDIDATE", 2)
    free = synthesize_with(GraspProblem(HAND, CAN).energy(SynthesisConfig().energy), CAN, 6, 0, SynthesisConfig())
    kept, turned = optimise(GraspProblem(HAND, CAN), 3, seed=0)
    assert turned == 0
    torch.testing.assert_close(kept.T_object_wrist, free.T_object_wrist[:3])
    assert not kept.extra
