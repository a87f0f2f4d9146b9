"""Settling: what closing does to a grasp decides what becomes of it."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from dro_grasp.energy.grasp_energy import EnergyConfig
from dro_grasp.errors import ObjectError
from dro_grasp.geometry.rotations import roma
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimization.fingers import lacking_room
from dro_grasp.optimization.synthesis import SynthesisConfig, synthesize
from dro_grasp.perception.partial_views import partial_view
from dro_grasp.pipeline import settling
from dro_grasp.pipeline.problem import GraspProblem
from dro_grasp.pipeline.settling import ROOM_WORTH, UNHELD_SCORE, Settled, best_settled, can_settle, settled
from dro_grasp.pipeline.stages import evaluate, refine, scored
from dro_grasp.simulation.closed_poses import hand_shift
from dro_grasp.simulation.holding import Holding, holding
from dro_grasp.simulation.outcome import Failure
from dro_grasp.simulation.trial import simulate
from tests.helpers.loaded_hands import loaded_hand

HAND, CAN = loaded_hand("gripper3"), load_object("can")
PROBLEM = GraspProblem(HAND, CAN)


@pytest.fixture(scope="module")
def grasps() -> GraspBatch:
    return refine(PROBLEM, synthesize(HAND, CAN, 5, 0, SynthesisConfig(batch_size=6, steps=20)))


def shifted(grasps: GraspBatch, distances: list[float]) -> GraspBatch:
    T = grasps.T_object_wrist.clone()
    T[:, 2, 3] += torch.tensor(distances)
    return grasps.without("pregrasp_joints", "squeeze_joints").replace(T_object_wrist=T)


@pytest.mark.parametrize("deep", [0.0, 0.006])
def test_still_grasps_squeeze_anew_others_are_refined_and_what_then_moves_or_is_deep_stays_as_it_was(
    grasps: GraspBatch, monkeypatch: pytest.MonkeyPatch, deep: float
) -> None:
    moved, seen = [0.001, 0.01, 0.002, 0.01, 0.3], []

    def state(shift: list[float], turn: list[float]) -> Holding:
        n = len(shift)
        return Holding(torch.tensor(shift), torch.tensor(turn), *(torch.arange(float(n)) for _ in range(6)),
                       unanswered=torch.zeros(n, 2))

    def close_again(hand: Hand, obj: ObjectModel, some: GraspBatch) -> Holding:
        seen.append(some)
        return state([0.001, 0.03, 0.0, 0.0], [0.0, 0.0, 0.6, 0.1])

    monkeypatch.setattr(settling, "settle", lambda hand, obj, some: shifted(some, moved))
    monkeypatch.setattr(settling, "holding", close_again)
    depths = torch.tensor([deep, 0.0, 0.0, 0.004])
    monkeypatch.setattr(settling, "deepest_penetration", lambda hand, obj, some: depths[:len(some)])
    found, held, kept = settled(PROBLEM, grasps)
    assert held.tolist() == [not deep, False, False, True, False]
    assert kept.speed.tolist() == ([3.0] if deep else [0.0, 3.0])
    T = grasps.T_object_wrist
    if deep:
        torch.testing.assert_close(found.T_object_wrist[0], T[0])
        return
    assert float(found.T_object_wrist[0, 2, 3] - T[0, 2, 3]) == pytest.approx(0.001, abs=1e-6)
    assert (found.squeeze_joints[0] - grasps.squeeze_joints[0]).abs().max() > 1e-4
    expected = refine(PROBLEM, shifted(grasps, moved)[[1, 3]])
    torch.testing.assert_close(seen[0].T_object_wrist[[1, 3]], expected.T_object_wrist)
    for name in ("T_object_wrist", "joints", "squeeze_joints"):
        torch.testing.assert_close(getattr(found, name)[3], getattr(expected, name)[1])
        torch.testing.assert_close(getattr(found, name)[[1, 2, 4]], getattr(grasps, name)[[1, 2, 4]])


def test_a_hand_has_moved_as_far_as_its_grasp_centre(grasps: GraspBatch) -> None:
    distances = [0.0, 0.01, 0.02, 0.03, 0.04]
    found = hand_shift(HAND, grasps, shifted(grasps, distances))
    torch.testing.assert_close(found, torch.tensor(distances), atol=1e-6, rtol=0)


def test_settled_grasps_hardly_push_the_object_away(grasps: GraspBatch) -> None:
    many = refine(PROBLEM, synthesize(HAND, CAN, 24, 1, SynthesisConfig(batch_size=24, steps=20)))
    found, held, _ = settled(PROBLEM, many)
    before, after = (simulate(HAND, CAN, g, "strict") for g in (many, found[held]))
    assert before.failure.count(Failure.PUSHED_AWAY) > 2
    assert after.failure.count(Failure.PUSHED_AWAY) <= 1


def test_only_the_better_half_is_settled_and_what_is_not_held_scores_low(
    grasps: GraspBatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none_held(problem: GraspProblem, some: GraspBatch) -> Settled:
        return Settled(some.without("score"), torch.zeros(len(some), dtype=torch.bool), holding(HAND, CAN, some[:0]))

    monkeypatch.setattr(settling, "settled", none_held)
    known = scored(PROBLEM, grasps).replace(score=torch.tensor([0.0, 3.0, 1.0, 2.0, -1.0]))
    rows, found = best_settled(PROBLEM, known, 1)
    assert rows.tolist() == [1, 3]
    assert found.score.amax() <= UNHELD_SCORE
    torch.testing.assert_close(found.T_object_wrist, known.T_object_wrist[[1, 3]])
    assert len(best_settled(PROBLEM, known, 4)[0]) == 4
    assert len(best_settled(PROBLEM, known, 9)[0]) == 5


def test_a_grasp_scores_lower_for_room_that_it_lacks_beside_what_was_not_seen(
    grasps: GraspBatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    cloud = partial_view(CAN, "cloud", 0)
    half = dataclasses.replace(cloud, seen=cloud.cloud[cloud.cloud[:, 0] > 0])
    monkeypatch.setattr(settling, "settle", lambda hand, obj, some: shifted(some, [0.0] * len(some)))
    (_, whole), (_, guessed) = (best_settled(p, scored(p, grasps), 5) for p in (GraspProblem(HAND, o) for o in (cloud, half)))
    torch.testing.assert_close(whole.joints, guessed.joints)
    problem = GraspProblem(HAND, half)
    lacking = lacking_room(problem.energy(EnergyConfig()), guessed, half.seen)
    assert float(lacking.max()) > 0.002
    torch.testing.assert_close(whole.score - guessed.score, ROOM_WORTH * lacking)


def test_a_hand_without_description_cannot_settle() -> None:
    assert can_settle(PROBLEM)
    assert can_settle(GraspProblem(HAND, partial_view(CAN, "cloud", 0)))
    assert not can_settle(GraspProblem(dataclasses.replace(HAND, description=None), CAN))


def test_on_a_bare_cloud_grasps_settle_where_they_do_on_the_mesh_and_get_no_trial() -> None:
    sphere = load_object("sphere")
    whole, bare = GraspProblem(HAND, sphere), GraspProblem(HAND, partial_view(sphere, "cloud", 0))
    some = refine(whole, synthesize(HAND, sphere, 6, 2, SynthesisConfig(batch_size=6, steps=20)))
    on_mesh, on_balls = settled(whole, some), settled(bare, some)
    both = on_mesh.held & on_balls.held
    assert both.sum() > 3
    assert hand_shift(HAND, on_mesh.grasps[both], on_balls.grasps[both]).median() < 0.002
    turned = [made.grasps.T_object_wrist[both, :3, :3] for made in (on_mesh, on_balls)]
    assert roma.rotmat_geodesic_distance(*turned).median() < 0.1
    gap = [p.field.distances(HAND.points(g.joints, g.T_object_wrist))[0].amin(1) for p, (g, _, _) in (
        (whole, on_mesh), (whole, on_balls))]
    assert (gap[0] - gap[1])[both].abs().max() < 0.003  # balls are some 1 mm low
    for _ in range(2):  # nothing that settling has built is found instead
        with pytest.raises(ObjectError, match="is a bare point cloud; a trial needs a mesh"):
            evaluate(bare, on_balls.grasps)
