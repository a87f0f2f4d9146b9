"""Fingers that fold back behind the palm are open where they span the most; all others are open at their limits."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

import dro_grasp as dro
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import hand_names
from tests.helpers.bracket_hand import bracket_urdf
from tests.helpers.claw_urdf import written
from tests.helpers.folding_hands import folding_bracket, folding_claw
from tests.helpers.loaded_hands import loaded_hand


def load(folder: Path, text: str) -> Hand:
    return dro.load_hand(written(folder, text, "hand.urdf"))


def limits(hand: Hand) -> torch.Tensor:
    return torch.where(hand.opening_signs > 0, hand.tree.upper, hand.tree.lower)


@pytest.mark.parametrize("back", [math.pi, 1.5 * math.pi - 0.1])
def test_fingers_that_fold_by_90_and_by_180_degrees_are_open_when_flat(tmp_path: Path, back: float) -> None:
    """They stand at zero and lie flat in the plane of the palm's face at -pi/2."""
    hand = load(tmp_path, folding_claw(back))
    assert hand.opening_signs.tolist() == [-1, -1]
    assert hand.open_ends.tolist() == pytest.approx([-math.pi / 2] * 2, abs=0.1)
    assert float(hand.palm_direction_wrist[2]) > 0.99


def test_fingers_that_lie_flat_at_their_limits_are_open_there(tmp_path: Path) -> None:
    hand = load(tmp_path, folding_claw(math.pi / 2))
    assert torch.equal(hand.open_ends, limits(hand))


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("back", [1.0, 1.5, 2.2])
def test_straight_fingers_that_roll_up_on_both_sides_open_straight(tmp_path: Path, side: float, back: float) -> None:
    """With limits of 1.5 rad both ways, nothing but the thumb tells the palm's side."""
    straight, hand = load(tmp_path, bracket_urdf(side)), load(tmp_path, folding_bracket(back, side))
    assert float(hand.palm_direction_wrist @ straight.palm_direction_wrist) > 0.99
    assert torch.equal(hand.opening_signs, straight.opening_signs)
    assert hand.open_ends.tolist() == pytest.approx([0.0] * 7, abs=0.05)
    assert hand.thumb == straight.thumb


def test_one_joint_that_folds_its_finger_back_is_cut(tmp_path: Path) -> None:
    hand = load(tmp_path, folding_bracket(1.5, pattern="base"))
    assert hand.open_ends.tolist() == pytest.approx([0.0] * 7, abs=0.05)


def test_a_little_more_than_straight_is_kept(tmp_path: Path) -> None:
    """As many hands have it: 0.2 rad in each joint."""
    hand = load(tmp_path, folding_bracket(0.2))
    assert torch.equal(hand.open_ends, limits(hand))
    assert sorted(set(hand.open_ends.tolist())) == pytest.approx([-0.2, 0.0])


@pytest.mark.parametrize("name", [n for n, source in hand_names().items() if source == "builtin"])
def test_built_in_hands_open_to_their_limits(name: str) -> None:
    hand = loaded_hand(name)
    assert torch.equal(hand.open_ends, limits(hand))


@pytest.mark.assets
@pytest.mark.parametrize("name", ["allegro_left", "shadowhand", "leaphand", "inspire", "ability", "dclaw", "orca", "ezgripper"])
def test_real_hands_open_to_their_limits(assets_folder: Path, name: str) -> None:
    hand = loaded_hand(f"assets/{name}")
    assert torch.equal(hand.open_ends, limits(hand))


def test_open_closed_and_random_joints_stay_in_front_of_the_palm(tmp_path: Path) -> None:
    hand = load(tmp_path, folding_claw(math.pi))
    assert torch.equal(hand.canonical_joints(1.0), hand.open_ends)
    assert torch.equal(hand.canonical_joints(0.0), hand.closed_ends)
    generator = torch.Generator().manual_seed(0)
    for joints in (hand.random_joints(50, generator), hand.random_open_joints(50, generator)):
        tips = hand.tree.forward(joints)[:, list(hand.tips), :3] @ torch.tensor([0.0, 0.0, 0.06, 1.0])
        assert float(tips[..., 2].min()) > 0.0


def test_a_bundle_without_open_ends_opens_to_the_limits(tmp_path: Path) -> None:
    hand = load(tmp_path, folding_claw(math.pi))
    values = hand.to_tensors()
    assert torch.equal(Hand.from_tensors(dict(values)).open_ends, hand.open_ends)
    del values["open_ends"]
    assert Hand.from_tensors(values).open_ends.tolist() == pytest.approx([-math.pi] * 2)
