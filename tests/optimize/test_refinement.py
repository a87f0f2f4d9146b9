"""Polishing: less depth by the simulator's measure, no higher energy, never beyond its bounds, on a mesh and on a cloud."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimize.grasp_energy import GraspEnergy
from dro_grasp.optimize.refinement import RefineConfig, refine_grasps
from dro_grasp.optimize.synthesis import SynthesisConfig, synthesize
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.stages import refine
from dro_grasp.simulation.trial import simulate
from tests.helpers.loaded_hands import loaded_hand

HAND = loaded_hand("gripper3")
CONFIG = RefineConfig()


@pytest.fixture(scope="module", params=["mesh", "cloud"])
def obj(request: pytest.FixtureRequest) -> ObjectModel:
    can = load_object("can")
    return can if request.param == "mesh" else dataclasses.replace(can, vertices=None, faces=None)


@pytest.fixture(scope="module")
def disturbed() -> GraspBatch:
    """Synthesized grasps pushed into the object and bent, as a network's predictions are."""
    made = synthesize(HAND, load_object("can"), 48, 0, SynthesisConfig(batch_size=48))[slice(0, 16)]
    generator = torch.Generator().manual_seed(0)
    T, q = made.T_object_wrist.clone(), made.joints.clone()
    T[:, :3, 3] += 0.008 * (T[:, :3, :3] @ HAND.palm_direction_wrist)
    q += 0.03 * torch.randn(q.shape, generator=generator)
    return made.replace(T_object_wrist=T, joints=q.clamp(HAND.tree.lower, HAND.tree.upper))


def test_the_simulator_finds_less_depth_and_more_successes(disturbed: GraspBatch) -> None:
    can = load_object("can")
    before = simulate(HAND, can, disturbed, "strict", workers=1)
    after = simulate(HAND, can, refine(GraspProblem(HAND, can), disturbed), "strict", workers=1)
    assert after.penetration.median() < 0.4 * before.penetration.median()
    assert int(after.success.sum()) >= int(before.success.sum()) + 4


def test_no_energy_rises_and_most_fall(obj: ObjectModel, disturbed: GraspBatch) -> None:
    energy = GraspEnergy.of_object(HAND, obj, CONFIG.energy)
    refined = refine_grasps(energy, disturbed)

    def total(grasps: GraspBatch) -> torch.Tensor:
        contacts = energy.nearest_contacts(grasps.T_object_wrist[:, None] @ HAND.tree.forward(grasps.joints), CONFIG.reach)
        return energy(grasps.T_object_wrist, grasps.joints, contacts).total

    before, after = total(disturbed), total(refined)
    assert bool((after <= before + 1e-3).all())
    assert (after < 0.8 * before).float().mean() > 0.8
    assert refined.score.isnan().all()
    stale = {"depth", *(name for name in disturbed.extra if name.startswith("energy_"))}
    assert stale <= disturbed.extra.keys()
    assert len(stale) > 1
    assert not refined.extra.keys() & stale
    assert not bool(refined.states_closing.any())


def test_grasps_stay_within_the_bounds_that_are_stated(disturbed: GraspBatch) -> None:
    tight = dataclasses.replace(CONFIG, farthest=0.003, largest_turn=0.02, largest_bend=0.03)
    for config in (CONFIG, tight):
        refined = refine_grasps(GraspEnergy.of_object(HAND, load_object("can"), config.energy), disturbed, config)
        centres = [HAND.grasp_centres(g.T_object_wrist) for g in (disturbed, refined)]
        moved = (centres[1] - centres[0]).norm(dim=-1)
        cosine = (disturbed.T_object_wrist[:, :3, :3] * refined.T_object_wrist[:, :3, :3]).sum((1, 2)) / 2 - 0.5
        bent = (refined.joints - disturbed.joints).abs()
        assert moved.max() <= config.farthest + 1e-5
        assert torch.arccos(cosine.clamp(-1, 1)).max() <= config.largest_turn + 2e-3
        assert bent.max() <= config.largest_bend + 1e-5
        assert bool((refined.joints >= HAND.tree.lower - 1e-6).all())
        assert bool((refined.joints <= HAND.tree.upper + 1e-6).all())
    assert moved.max() > 0.0029, "the tight bound is reached"


def test_the_batch_size_changes_nothing(disturbed: GraspBatch) -> None:
    can = load_object("can")
    whole, parts = (refine(GraspProblem(HAND, can), disturbed, dataclasses.replace(CONFIG, batch_size=n)) for n in (64, 5))
    # Single precision: a step that is barely kept in one batch may barely be dropped in the other.
    apart = (whole.joints - parts.joints).abs().amax(-1)
    assert (apart < 1e-3).float().mean() > 0.8
    assert len(refine(GraspProblem(HAND, can), disturbed[slice(0, 0)])) == 0


def test_contacts_are_not_sought_with_fingers_out_of_reach() -> None:
    can = load_object("can")
    energy = GraspEnergy.of_object(HAND, can, CONFIG.energy)
    far = torch.eye(4)[None].clone()
    far[:, :3, 3] = 0.06
    q = HAND.canonical_joints(0.0)[None]
    poses = far[:, None] @ HAND.tree.forward(q)
    near = energy.nearest_contacts(poses)
    every = energy.candidates.fingers[near[0]]
    reached = energy.nearest_contacts(poses, reach=0.0)
    one = energy.candidates.fingers[reached[0]]
    assert len(set(every.tolist())) > 1
    assert len(set(one.tolist())) == 1  # out of reach, all slots go to the finger that is nearest
    assert len(set(reached[0].tolist())) == reached.shape[1]
    assert energy(far, q).total.isfinite().all()


def test_refinement_opens_no_finger_beyond_the_hand(disturbed: GraspBatch) -> None:
    """Of a hand that opens only half as far as its limits; a grasp that is beyond already goes no farther."""
    half = dataclasses.replace(HAND, open_ends=(HAND.open_ends + HAND.closed_ends) / 2)
    energy = GraspEnergy.of_object(half, load_object("can"), CONFIG.energy)
    refined = refine_grasps(energy, disturbed)
    before, after = ((half.lower - grasps.joints).maximum(grasps.joints - half.upper) for grasps in (disturbed, refined))
    assert float(before.max()) > 0.05, "some grasps are beyond"
    assert bool((after <= before.clamp_min(0) + 1e-5).all())
