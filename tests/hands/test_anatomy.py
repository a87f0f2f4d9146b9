"""Fingers, thumb, rigid groups and opening signs: derived once, read by energy, viewer and check alike."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from dro_grasp.hands.anatomy import PALM, find_fingers
from dro_grasp.hands.hand import Hand
from dro_grasp.optimize.contacts import contact_candidates
from dro_grasp.pictures.appearance import link_colours
from tests.helpers.bracket_hand import bracket_hand
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.toy_hand import toy_hand


@pytest.fixture(scope="module")
def bracket(tmp_path_factory: pytest.TempPathFactory) -> Hand:
    return bracket_hand(tmp_path_factory.mktemp("bracket"))


def test_energy_and_viewer_see_the_same_fingers(bracket: Hand) -> None:
    candidates, colours = contact_candidates(bracket), link_colours(bracket)
    pairs = zip(candidates.fingers.tolist(), candidates.links.tolist(), strict=True)
    seen = {(finger, colours[link]) for finger, link in pairs}
    assert {finger for finger, _ in seen} == {PALM, 0, 1, 2, 3}
    assert len(seen) == len({colour for _, colour in seen}) == 5, "each finger has one colour, and each colour one finger"


def test_a_bracket_belongs_to_the_palm_and_a_pad_to_its_finger(bracket: Hand) -> None:
    names = bracket.tree.link_names
    fingers = {names[finger.tip]: {names[link]: k for link, k in zip(finger.links, finger.joints_to_tip, strict=True)}
               for finger in bracket.fingers}
    assert fingers == {"distal0": {"proximal0": 1, "distal0": 0, "pad": 0}, "distal1": {"proximal1": 1, "distal1": 0},
                       "distal2": {"proximal2": 1, "distal2": 0}, "thumb": {"thumb": 0}}
    assert [[names[link] for link in finger.chain] for finger in bracket.fingers] == [
        ["proximal0", "distal0"], ["proximal1", "distal1"], ["proximal2", "distal2"], ["thumb"]]
    group = {name: names[top] for name, top in zip(names, bracket.rigid_group, strict=True)}
    assert {name: top for name, top in group.items() if name != top} == {"bracket": "palm", "pad": "proximal0"}


def test_a_moving_link_that_carries_two_tips_is_in_both_chains_and_of_neither_finger() -> None:
    tree = toy_hand().tree
    # The third finger grows out of the first one's proximal link.
    forked = dataclasses.replace(tree, parent=(-1, 0, 1, 0, 3, 1, 5))
    first, second, third = find_fingers(forked, (2, 4, 6), 0)
    assert (first.chain, second.chain, third.chain) == ((1, 2), (3, 4), (1, 5, 6))
    assert (first.links, second.links, third.links) == ((2,), (3, 4), (5, 6))
    assert third.joints_to_tip == (1, 0)


def test_thumb_opposition_is_that_of_moving_fingertips(bracket: Hand) -> None:
    """Against differences of the fingertips' positions around the half-closed hand."""
    step, ends = 1e-3, []
    for closing in (0.55 - step, 0.55 + step):
        poses = bracket.tree.forward(bracket.canonical_joints(1 - closing))[list(bracket.tips)].double().numpy()
        ends.append((poses[:, :3, :3] @ bracket.tip_offsets.double().numpy()[..., None])[..., 0] + poses[:, :3, 3])
    moved = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0], axis=1, keepdims=True)
    cosines = moved @ moved.T
    expected = [-np.delete(cosines[i], i).mean() for i in range(4)]
    np.testing.assert_allclose(bracket.thumb_opposition.numpy(), expected, atol=1e-2)
    assert bracket.thumb == int(np.argmax(expected)) == 3


@pytest.mark.parametrize(("name", "thumb"), [("allegro", 3), ("leaphand", 3), ("shadowhand", 4), ("barrett", None)])
def test_thumbs_of_built_in_hands(name: str, thumb: int | None) -> None:
    assert loaded_hand(name).thumb == thumb


@pytest.mark.assets
@pytest.mark.parametrize(
    ("name", "thumb"),
    [("allegro_left", "link_15.0_tip"), ("ability", "thumb_L2"), ("barrett_multidex", None)],
)
def test_thumbs_of_real_hands(assets_folder: Path, name: str, thumb: str | None) -> None:
    hand = loaded_hand(f"assets/{name}")
    assert (None if hand.thumb is None else hand.tree.link_names[hand.tips[hand.thumb]]) == thumb


def anatomy(hand: Hand) -> tuple[object, ...]:
    return hand.fingers, hand.rigid_group, hand.thumb, hand.tips, hand.opening_signs.tolist(), hand.contact_links


def test_the_anatomy_survives_thinning_and_storage(bracket: Hand) -> None:
    assert anatomy(bracket.with_points(64)) == anatomy(bracket)
    stored = {k: list(v) if isinstance(v, tuple) else v for k, v in bracket.to_tensors().items()}
    assert anatomy(Hand.from_tensors(stored)) == anatomy(bracket)
    moved = bracket.to("meta")
    assert (moved.fingers, moved.rigid_group, moved.thumb) == (bracket.fingers, bracket.rigid_group, bracket.thumb)
    assert moved.finger_of_link.device.type == moved.thumb_opposition.device.type == "meta"


def test_a_stored_hand_without_anatomy_has_it_derived(bracket: Hand) -> None:
    """Bundles name opening signs and contact links as they always have, and hold no fingers."""
    stored = bracket.to_tensors()
    assert {"opening", "touching", "tips"} <= set(stored)
    assert not {"fingers", "rigid_group", "thumb", "opening_signs", "contact_links"} & set(stored)


def test_random_joints_stay_within_limits_and_hold_joints_above_the_palm(bracket: Hand) -> None:
    held = torch.arange(bracket.tree.n_dof) == 2
    hand = dataclasses.replace(bracket, movable=~held, rest=torch.full((bracket.tree.n_dof,), 0.2))
    q = hand.random_joints(500, torch.Generator().manual_seed(0))
    assert q.shape == (500, hand.tree.n_dof)
    assert (q[:, held] == 0.2).all()
    share = (q[:, ~held] - hand.tree.lower[~held]) / (hand.tree.upper - hand.tree.lower)[~held]
    assert float(share.min()) >= 0
    assert float(share.max()) <= 1
    torch.testing.assert_close(share.mean(0), torch.full_like(share[0], 0.5), atol=0.05, rtol=0)
    again = hand.random_joints(500, torch.Generator().manual_seed(0))
    assert torch.equal(q, again)
