"""Scores put good grasps before worse ones, on a mesh and on a bare cloud."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from dro_grasp.compare.metrics import roc_area
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimize.grasp_energy import GraspEnergy
from dro_grasp.optimize.synthesis import SynthesisConfig, synthesize
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.score.score import ScoreConfig
from dro_grasp.predict.stages import scored
from dro_grasp.simulation.trial import simulate
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.one_object import settle
from tests.helpers.toy_hand import toy_hand

HAND = toy_hand()


@pytest.fixture(scope="module", params=["mesh", "cloud"])
def obj(request) -> ObjectModel:
    ball = load_object("sphere")
    return ball if request.param == "mesh" else dataclasses.replace(ball, vertices=None, faces=None)


@pytest.fixture(scope="module")
def grasps() -> GraspBatch:
    made = synthesize(HAND, load_object("sphere"), 48, 0, SynthesisConfig(steps=120, batch_size=48))
    return made[slice(0, 16)]


def spoilt(grasps: GraspBatch, how: str) -> GraspBatch:
    T, q = grasps.T_object_wrist.clone(), grasps.joints.clone()
    palm = T[:, :3, :3] @ HAND.palm_direction_wrist
    if how == "too far":
        T[:, :3, 3] -= 0.02 * palm
    elif how == "too deep":
        T[:, :3, 3] += 0.02 * palm
    else:
        q = HAND.canonical_joints(1.0).expand_as(q).clone()
    return grasps.replace(T_object_wrist=T, joints=q)


def test_scores_tell_what_holds_from_what_does_not():
    """Of grasps of a hand and an object, as they are and spoilt, those that hold score higher."""
    hand, can = loaded_hand("allegro"), load_object("can")
    made = settle(hand, can, synthesize(hand, can, 64, 0)[slice(0, 28)])
    T = made.T_object_wrist.clone()
    T[:, :3, 3] -= 0.03 * hand.palm_directions(T)
    opened = hand.canonical_joints(1.0).expand_as(made.joints)
    bare = made.without("pregrasp_joints", "squeeze_joints")
    mixed = GraspBatch.concatenate([made, bare.replace(T_object_wrist=T), bare.replace(joints=opened)])
    held = simulate(hand, can, mixed, "strict").success
    assert 6 < int(held.sum()) < 60
    assert roc_area(scored(GraspProblem(hand, can), mixed).score, held) > 0.75


def test_score_does_not_depend_on_the_batch(obj, grasps):
    whole = scored(GraspProblem(HAND, obj), grasps).score
    parts = scored(GraspProblem(HAND, obj), grasps, ScoreConfig(batch_size=5)).score
    torch.testing.assert_close(whole, parts, atol=1e-4, rtol=1e-4)
    assert scored(GraspProblem(HAND, obj), grasps[slice(0, 0)]).score.shape == (0,)


def test_mesh_and_cloud_agree(grasps):
    ball = load_object("sphere")
    mixed = GraspBatch.concatenate([grasps, *(spoilt(grasps, how) for how in ("too far", "too deep", "open"))])
    on_mesh = scored(GraspProblem(HAND, ball), mixed).score
    on_cloud = scored(GraspProblem(HAND, dataclasses.replace(ball, vertices=None, faces=None)), mixed).score
    assert torch.corrcoef(torch.stack([on_mesh, on_cloud]))[0, 1] > 0.95


def test_nearest_contacts_agree_with_a_plain_search(grasps):
    energy = GraspEnergy.of_object(HAND, load_object("sphere"), ScoreConfig().energy)
    chosen = energy.nearest_contacts(grasps.T_object_wrist[:, None] @ HAND.tree.forward(grasps.joints))
    candidates = energy.candidates
    for i in range(len(grasps)):
        poses = grasps.T_object_wrist[i] @ HAND.tree.forward(grasps.joints[i])
        taken: list[int] = []
        for slot, weights in enumerate(candidates.slot_weights):
            allowed = [k for k in range(len(weights)) if weights[k] > 0 and k not in taken]
            points = torch.stack([
                poses[candidates.links[k], :3, :3] @ candidates.points[k] + poses[candidates.links[k], :3, 3]
                for k in allowed
            ])
            distance = energy.field.distances(points)[0].abs()
            assert distance[allowed.index(int(chosen[i, slot]))] < distance.min() + 1e-5  # [m]
            taken.append(int(chosen[i, slot]))
