"""The stages between proposal and trial: what they share, what they refuse, what they leave alone."""

from __future__ import annotations

import time
from dataclasses import replace

import pytest
import torch

from dro_grasp.devices import Stopwatch
from dro_grasp.errors import GraspFileError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.perception.partial_views import partial_view
from dro_grasp.optimize.grasp_energy import EnergyConfig, GraspEnergy
from dro_grasp.optimize.synthesis import SynthesisConfig, synthesize, synthesize_with
from dro_grasp.predict.admission import AdmissionConfig, feasible
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.optimiser import OptimiserConfig, OptimiserSource
from dro_grasp.predict.stages import complete, ease, evaluate, rank, refine, scored
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
    assert ease(PROBLEM, whole) is whole, "a mesh is known"
    cloud = GraspProblem(HAND, partial_view(CAN, "cloud", 0))
    given = whole.replace(score=torch.arange(6.0))
    apart = ease(cloud, given)
    for name in ("T_object_wrist", "pregrasp_joints", "squeeze_joints", "score"):
        assert torch.equal(getattr(apart, name), getattr(given, name))
    clear = [CAN.distance_field.distances(HAND.points(g.joints, g.T_object_wrist))[0].amin(-1) for g in (given, apart)]
    assert float((clear[1] - clear[0]).max()) > 0.002
    assert float((clear[1] - clear[0]).min()) > -1e-4
    below = GraspProblem(HAND, cloud.obj, constraints=Constraints(max_tilt=0.01, direction=(0.0, 0.0, 1.0)))
    assert torch.equal(ease(below, given).joints, given.joints), "none of these grasps is feasible"


def test_where_the_wider_room_is_forbidden_fingers_leave_that_of_a_surface_that_was_seen(grasps: GraspBatch) -> None:
    """Forbidden by a place to hold that all fingers have to be near to, farther off than the narrow room and nearer than the
    wide one."""
    whole = partial_view(PROBLEM.obj, "cloud", 0)
    seen = replace(whole, seen=whole.cloud[whole.cloud[:, 0] > 0])
    everywhere = Constraints(contact_region=((0.0, 0.0, 0.0, 1.0),))
    plain, half = (GraspProblem(HAND, o, constraints=everywhere) for o in (whole, seen))
    given = complete(plain, grasps)
    free = AdmissionConfig(fewest_fingers=0)
    narrow, wide = (ease(problem, given, None, free) for problem in (plain, half))
    gaps = [farthest_finger(plain, eased) for eased in (narrow, wide)]
    row = int((gaps[1] - gaps[0]).argmax())
    assert float(gaps[1][row] - gaps[0][row]) > 0.001
    near = AdmissionConfig(fewest_fingers=3, reach=float(gaps[0][row] + gaps[1][row]) / 2)
    one = slice(row, row + 1)
    assert feasible(half, narrow[one], near).all()
    assert not feasible(half, wide[one], near).any()
    torch.testing.assert_close(ease(half, given[one], None, near).joints, narrow.joints[one])
    nowhere = replace(near, reach=-1.0)
    assert torch.equal(ease(half, given[one], None, nowhere).joints, given.joints[one])


def farthest_finger(problem: GraspProblem, grasps: GraspBatch) -> torch.Tensor:
    """Distance of the finger that is farthest from the object [m]."""
    distance, finger = (problem.field.distances(HAND.points(grasps.joints, grasps.T_object_wrist))[0],
                        HAND.finger_of_link[HAND.link_index])
    return torch.stack([distance[:, finger == index].amin(-1) for index in range(len(HAND.fingers))]).amax(0)


def test_a_stopwatch_adds_up_and_lists_what_never_ran() -> None:
    watch = Stopwatch("slept", "never")
    for _ in range(2):
        with watch("slept"):
            time.sleep(0.01)
    assert watch.seconds["never"] == 0
    assert watch.seconds["slept"] >= 0.02


def test_optimised_candidates_are_those_of_lowest_energy() -> None:
    free = synthesize_with(GraspProblem(HAND, CAN).energy(SynthesisConfig().energy), CAN, 6, 0, SynthesisConfig())
    made = OptimiserSource(OptimiserConfig(starts_per_candidate=2)).propose(GraspProblem(HAND, CAN), 3, seed=0)
    assert made.turned == 0
    torch.testing.assert_close(made.grasps.T_object_wrist, free.T_object_wrist[:3])
    assert not made.grasps.extra
    torch.testing.assert_close(made.points, HAND.with_points(160).points(made.grasps.joints, made.grasps.T_object_wrist))
