"""Plans of procedural hands and their URDF: against MuJoCo's own masses, mirrors, and plans that cannot grasp."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

import dro_grasp as dro
from dro_grasp.errors import OptionError
from dro_grasp.hands.check import check_hand
from dro_grasp.hands.description.loader import load_description, self_penetration
from dro_grasp.training.made_hands.making import make_hand, posture, why_unfit
from dro_grasp.training.made_hands.plan import FingerPlan, HandPlan, write_urdf
from dro_grasp.training.made_hands.sampling import sample_plan
from tests.helpers.claw_urdf import joint, link, written


def plan_of(seed: int) -> HandPlan:
    """The first plan of a seed, whether it can grasp or not."""
    return sample_plan(np.random.default_rng(seed))


def test_a_seed_gives_one_plan_and_every_seed_another() -> None:
    texts = [write_urdf(plan_of(seed), "hand") for seed in range(30)]
    assert texts == [write_urdf(plan_of(seed), "hand") for seed in range(30)]
    assert len(set(texts)) == 30


def test_plans_vary_in_all_that_they_promise() -> None:
    plans = [plan_of(seed) for seed in range(120)]
    assert {len(plan.fingers) for plan in plans} == {2, 3, 4, 5}
    assert {plan.side for plan in plans} == {"left", "right", "none"}
    assert {plan.thumb for plan in plans} == {"opposed", "lateral", "none"}
    assert {plan.palm_shape for plan in plans} == {"box", "disc", "rounded", "two-part"}
    assert {plan.folds_back for plan in plans} == {True, False}
    assert {plan.followers > 0 for plan in plans} == {True, False}
    kinds = {solid.kind for plan in plans for finger in plan.fingers for s in finger.segments for solid in s.solids}
    assert kinds == {"box", "cylinder", "sphere"}


@pytest.mark.parametrize("seed", range(4))
def test_masses_and_inertias_are_those_of_the_solids(tmp_path: Path, seed: int) -> None:
    """MuJoCo integrates its own geoms, which overlap as the solids do."""
    plan = dataclasses.replace(plan_of(seed), density=1000.0)
    stated = load_description(written(tmp_path, write_urdf(plan, "hand"))).model
    spec = mujoco.MjSpec.from_file(str(tmp_path / "claw.urdf"))
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    spec.compiler.fusestatic = False
    integrated = spec.compile()
    assert integrated.nbody == stated.nbody > 3
    assert stated.body_mass[1:] == pytest.approx(integrated.body_mass[1:], rel=5e-4)
    assert stated.body_ipos[1:] == pytest.approx(integrated.body_ipos[1:], abs=5e-6)
    assert np.sort(stated.body_inertia)[1:] == pytest.approx(np.sort(integrated.body_inertia)[1:], rel=3e-3)


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_the_mirrored_plan_moves_as_the_mirror_image(tmp_path: Path, seed: int) -> None:
    plan = plan_of(seed)
    this, other = (load_description(written(tmp_path, write_urdf(p, "hand"), f"{i}.urdf")).tree
                   for i, p in enumerate((plan, plan.mirrored())))
    share = torch.rand(this.n_dof, generator=torch.Generator().manual_seed(seed))
    q = this.lower + share * (this.upper - this.lower)
    mirror = torch.diag(torch.tensor([1.0, -1.0, 1.0, 1.0]))
    torch.testing.assert_close(other.forward(q), mirror @ this.forward(q) @ mirror, atol=1e-5, rtol=0)
    assert plan.mirrored().mirrored() == plan


def test_followers_follow_the_joint_before_within_their_limits(tmp_path: Path) -> None:
    plan = next(p for p in map(plan_of, range(100)) if p.followers > 4)
    tree = load_description(written(tmp_path, write_urdf(plan, "hand"))).tree
    assert tree.n_dof == plan.joints - plan.followers == len(plan.open_posture())
    for finger in plan.fingers:
        for before, segment in itertools.pairwise(finger.segments):
            if segment.follows is not None:
                ends = sorted((segment.follows * before.lower, segment.follows * before.upper))
                assert (segment.lower, segment.upper) == pytest.approx(tuple(ends))


def test_links_that_penetrate_are_found_with_their_depth(tmp_path: Path) -> None:
    """Two balls of 1 cm on slides, 3 cm apart at zero; the neighbours of a link may overlap it."""
    ball = '<sphere radius="0.01"/>'
    joints = (joint("a", "palm", "left", "-0.015 0 0.1", "1 0 0", '<limit lower="0" upper="0.03"/>', "prismatic")
              + joint("b", "palm", "right", "0.015 0 0.1", "1 0 0", '<limit lower="-0.03" upper="0"/>', "prismatic"))
    palm = '<link name="palm"><collision><geometry><box size="0.5 0.5 0.25"/></geometry></collision></link>'
    text = f'<robot name="balls">{palm}{link("left", ball)}{link("right", ball)}{joints}</robot>'
    description = load_description(written(tmp_path, text))
    assert self_penetration(description, torch.zeros(2)) == {}
    assert self_penetration(description, torch.tensor([0.01, -0.006])) == {("left", "right"): pytest.approx(0.006, abs=1e-6)}


@pytest.fixture(scope="module")
def row() -> HandPlan:
    """A kept plan with a lateral thumb and at least three fingers beside it."""
    plans = (make_hand(seed).plan for seed in range(2, 20))
    return next(plan for plan in plans if plan.thumb == "lateral" and len(plan.fingers) > 3)


def reason(folder: Path, plan: HandPlan) -> str:
    return why_unfit(plan, check_hand(written(folder, write_urdf(plan, "hand"))))


def with_thumb(plan: HandPlan, change: Callable[[FingerPlan], FingerPlan]) -> HandPlan:
    return dataclasses.replace(plan, fingers=(*plan.fingers[:-1], change(plan.fingers[-1])))


def bent(finger: FingerPlan, lower: float, upper: float) -> FingerPlan:
    """The finger with other limits."""
    return dataclasses.replace(finger, segments=tuple(
        dataclasses.replace(s, lower=lower, upper=upper, open=lower) for s in finger.segments))


def test_faults_are_named(tmp_path: Path, row: HandPlan) -> None:
    assert reason(tmp_path, row) == ""
    x, y, z = row.palm_direction
    assert "palm direction" in reason(tmp_path, dataclasses.replace(row, palm_direction=(-x, -y, -z)))
    wrong_side = {"left": "right", "right": "left"}[row.side]
    assert "other side" in reason(tmp_path, dataclasses.replace(row, side=wrong_side))
    twice = (*row.fingers[:1], dataclasses.replace(row.fingers[0], name="again"), *row.fingers[2:])
    assert "overlap" in reason(tmp_path, dataclasses.replace(row, fingers=twice))
    assert reason(tmp_path, with_thumb(row, lambda thumb: bent(thumb, -0.01, 0.01)))


@pytest.mark.parametrize("seed", [0, 6, 13])
def test_a_made_hand_loads_and_is_open_when_open(tmp_path: Path, seed: int) -> None:
    made = dro.make_hand(seed)
    assert made.urdf == dro.make_hand(seed).urdf
    hand = dro.load_hand(written(tmp_path, made.urdf))
    assert len(hand.fingers) == made.facts()["fingers"]
    assert hand.description is not None
    assert max(self_penetration(hand.description, posture(made.plan, hand)).values(), default=0) < 1e-3
    assert 0.05 < hand.description.masses.sum() < 3
    assert not [note for note in check_hand(tmp_path / "claw.urdf").notes if note.level == "warning"]


def test_a_negative_seed_is_refused() -> None:
    with pytest.raises(OptionError, match="seed is -1"):
        dro.make_hand(-1)
