"""Variations: whose they are, how far they lie, and what they leave alone."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.objects.catalogue import load_object
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.source import ask
from dro_grasp.predict.sources.variation import VariationConfig, VariationSource
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.tiny_bundle import made_up_grasps

PROBLEM = GraspProblem(loaded_hand("gripper3"), load_object("ball"))
HAND = PROBLEM.hand
EVEN = VariationConfig(narrowest=1.0)
"""All as wide as the widest, so that spreads are those that are stated."""


def known(scores: list[float]) -> GraspBatch:
    """Grasps whose hands are far from each other and half closed, with these scores."""
    grasps = made_up_grasps(HAND, PROBLEM.obj.name, len(scores))
    T = torch.eye(4).repeat(len(scores), 1, 1)
    T[:, 0, 3] = 10.0 * torch.arange(len(scores))
    return grasps.with_poses(T, HAND.canonical_joints(0.5).expand(len(scores), -1).contiguous()).replace(
        score=torch.tensor(scores))


def parents(made: GraspBatch) -> torch.Tensor:
    """Which hand each variation is near."""
    return (made.T_object_wrist[:, 0, 3] / 10.0).round().long()


def test_hands_move_as_far_as_is_stated() -> None:
    """Of 4000, the grasp centre, the rotation and each joint have the stated deviations along every axis."""
    config = dataclasses.replace(EVEN, shift=0.02, turn=0.1, bend=0.05)
    made = VariationSource(known([0.0]), config).propose(PROBLEM, 4000, 3)
    before = HAND.grasp_centres(torch.eye(4)[None])
    moved = (HAND.grasp_centres(made.T_object_wrist) - before).std(0)
    np.testing.assert_allclose(moved, 0.02, rtol=0.05)
    turned = Rotation.from_matrix(made.T_object_wrist[:, :3, :3].numpy()).as_rotvec().std(0)
    np.testing.assert_allclose(turned, 0.1, rtol=0.05)
    bent = (made.joints - HAND.canonical_joints(0.5)) / HAND.tree.joint_unit
    inside = (HAND.upper - HAND.lower) / HAND.tree.joint_unit > 0.8
    assert bool(inside.any())
    np.testing.assert_allclose(bent.std(0)[inside & HAND.movable], 0.05, rtol=0.05)


def test_each_variation_has_its_own_width() -> None:
    """Deviations of s times the widest, s even from 0 to 1, have a mean square of a third."""
    config = VariationConfig(narrowest=0.0, shift=0.02, turn=0.0)
    made = VariationSource(known([0.0]), config).propose(PROBLEM, 8000, 3)
    assert float(made.T_object_wrist[:, :3, 3].var(0).mean()) == pytest.approx(0.02**2 / 3, rel=0.05)


def test_the_best_are_varied_and_the_better_oftener() -> None:
    """One unit of score below `alike` is worth a factor of e to the sharpness; above it all are alike."""
    config = dataclasses.replace(EVEN, parents=4, alike=1.0, sharpness=0.7)
    source = VariationSource(known([0.0, 5.0, 1.0, -9.0, -1.0]), config)
    counts = torch.bincount(parents(source.propose(PROBLEM, 8000, 1)), minlength=5)
    assert counts[3] == 0, "the worst of five is no parent"
    weight = np.array([math.exp(-0.7), 1.0, 1.0, 0.0, math.exp(-1.4)])
    np.testing.assert_allclose(counts / 8000, weight / weight.sum(), atol=0.02)


def test_joints_stay_within_limits_and_those_that_do_not_move_stay() -> None:
    hand = dataclasses.replace(HAND)
    made = VariationSource(known([0.0]), dataclasses.replace(EVEN, bend=5.0)).propose(PROBLEM, 200, 1)
    assert bool(((made.joints >= hand.lower - 1e-6) & (made.joints <= hand.upper + 1e-6)).all())
    fixed = ~HAND.movable
    torch.testing.assert_close(made.joints[:, fixed], HAND.canonical_joints(0.5)[fixed].expand(200, -1))


def test_the_same_seed_gives_the_same_variations() -> None:
    source = VariationSource(known([0.0, 1.0]))
    first, again, other = (source.propose(PROBLEM, 8, seed) for seed in (1, 1, 2))
    assert torch.equal(first.joints, again.joints)
    assert torch.equal(first.T_object_wrist, again.T_object_wrist)
    assert not torch.equal(first.joints, other.joints)


def test_they_carry_nothing_over_from_their_parents() -> None:
    """Pregrasp, squeeze, scores and forces are the parent's, not theirs."""
    candidates = ask(VariationSource(known([0.0, 1.0])), PROBLEM, 6, 1)
    assert candidates.origin == ("variation",) * 6
    for name in ("pregrasp_joints", "squeeze_joints", "score", "payload"):
        assert bool(getattr(candidates.grasps, name).isnan().all()), name
