"""Hands with one jaw that moves: the other jaw is part of the palm's link."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from dro_grasp.hands.anatomy import PALM
from dro_grasp.hands.check import check_hand
from dro_grasp.hands.closing import find_fixed_jaw, fixed_jaw_of
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimize.contacts import contact_candidates
from dro_grasp.optimize.synthesis import synthesize
from dro_grasp.simulation.trial import simulate
from tests.helpers.claw_urdf import claw, joint, link, written

TOP = 0.03
"""Height of the block between the jaws [m]."""
JAW = '<box size="0.012 0.03 0.06"/>'


def jaws(folder: Path, kind: str = "turns", side: float = 1.0, axis: float = 1.0, *, bare: bool = False) -> Hand:
    """A block with a jaw that is fixed to it, on this side, and one that moves towards that.

    The moving jaw turns, slides, or folds: it turns until its tip is beside the wrist. A block may be without jaw, and a jaw
    without a block: then the moving jaw carries the motor.
    """
    boxes = [("0.06 0.04 0.03", "0 0 0.015"), ("0.03 0.03 0.1", "0 0 -0.05")]
    boxes = [("0.012 0.03 0.03", f"{side * 0.03} 0 0.015")] if kind == "no block" else boxes
    boxes += [] if bare else [("0.012 0.03 0.06", f"{side * 0.03} 0 0.06")]
    shapes = "".join(f'<{kind}><origin xyz="{at}"/><geometry><box size="{size}"/></geometry></{kind}>'
                     for size, at in boxes for kind in ("visual", "collision"))
    opened, closed = {"turns": (-0.9, 0.4), "no block": (-0.9, 0.4), "folds": (-2.2, 0.4), "slides": (-0.02, 0.02)}[kind]
    low, high = sorted(axis * end for end in (opened, closed))
    limit = f'<limit lower="{low}" upper="{high}" effort="1" velocity="1"/>'
    way, type_ = (f"{axis * side} 0 0", "prismatic") if kind == "slides" else (f"0 {axis * side} 0", "revolute")
    moving = link("moving", JAW) + joint("jaw", "block", "moving", f"{-side * 0.012} 0 {TOP}", way, limit, type_)
    return load_hand(written(folder, f'<robot name="tongs"><link name="block">{shapes}</link>{moving}</robot>', "tongs.urdf"))


@pytest.mark.parametrize("kind", ["turns", "folds", "slides", "no block"])
@pytest.mark.parametrize("axis", [1.0, -1.0])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_one_jaw_closes_on_the_other_and_the_palm_faces_where_both_point(
    tmp_path: Path, side: float, axis: float, kind: str
) -> None:
    hand = jaws(tmp_path, kind, side, axis)
    assert hand.opening_signs.tolist() == [-axis]
    assert float(hand.palm_direction_wrist[2]) > 0.9
    assert float(hand.grasp_centre_wrist[2]) > TOP
    jaw = fixed_jaw_of(hand)
    assert jaw is not None
    height = hand.points(hand.rest)[:, 2].numpy()
    on_block = hand.link_index.numpy() == hand.palm
    assert (height[jaw.mask] > TOP - 0.01).all()
    assert jaw.mask[on_block & (height > TOP + 0.025)].all()
    assert on_block[jaw.mask].all()


@pytest.mark.parametrize(("bare", "level", "text"), [
    (True, "warning", "only fingertip"), (False, "info", "closes on a jaw that is part of 'block'")])
def test_the_check_tells_a_fixed_jaw_from_a_block(tmp_path: Path, bare: bool, level: str, text: str) -> None:
    hand = jaws(tmp_path, bare=bare)
    assert (fixed_jaw_of(hand) is None) == bare
    (note,) = [note for note in check_hand(tmp_path / "tongs.urdf").notes if note.subject == "moving"]
    assert note.level == level
    assert text in note.text


def test_a_finger_that_folds_onto_a_flat_palm_finds_no_jaw(tmp_path: Path) -> None:
    hand = load_hand(written(tmp_path, claw(links=link("left"), joints=joint("a", "palm", "left", "-0.035 0 0.01"))))
    assert fixed_jaw_of(hand) is None


def test_a_palm_without_surface_or_all_beyond_the_knuckle_is_no_jaw() -> None:
    points = np.random.default_rng(0).uniform(0, 1, (80, 3)) * [1.0, 0.1, 0.1]
    on_palm = np.arange(80) < 40
    points[on_palm] += [0.4, 0.0, 0.3]
    before = points - np.where(on_palm, 0, 0.01 * points[:, 0])[:, None] * [0.0, 0.0, 1.0]
    assert find_fixed_jaw(before, points, on_palm, ~on_palm) is None
    points[0] = before[0] = [0.0, 0.0, 0.3]  # a knuckle
    assert find_fixed_jaw(before, points, on_palm, ~on_palm) is not None
    assert find_fixed_jaw(before, points, np.ones(80, bool), ~on_palm) is None  # as for a palm that no sample is on
    assert find_fixed_jaw(before, points, np.zeros(80, bool), ~on_palm) is None


def test_a_finger_that_stands_still_finds_no_jaw() -> None:
    points = np.random.default_rng(0).normal(size=(40, 3))
    on_palm = np.arange(40) < 20
    assert find_fixed_jaw(points, points, on_palm, ~on_palm) is None


def test_a_single_finger_and_what_it_closes_on_have_a_slot_each(tmp_path: Path) -> None:
    found = contact_candidates(jaws(tmp_path))
    drawn = found.fingers[found.draw(400, torch.Generator().manual_seed(0))]
    assert (drawn[:, 0] == 0).all()
    assert (drawn[:, 1] == PALM).all()
    assert torch.allclose((drawn[:, 2:] == PALM).float().mean(0), torch.full((2,), 0.5), atol=0.1)


def test_synthesized_grasps_hold_between_the_jaws(tmp_path: Path) -> None:
    hand, rod = jaws(tmp_path), load_object("rod")
    trial = simulate(hand, rod, synthesize(hand, rod, 32), "strict")
    assert int(trial.success.sum()) >= 12  # 17; 6 where the palm faces the fixed jaw and contacts are drawn as for other hands
    held = [links for links, success in zip(trial.contact_links, trial.success.tolist(), strict=True) if success]
    assert all(set(links) == {"block", "moving"} for links in held)
