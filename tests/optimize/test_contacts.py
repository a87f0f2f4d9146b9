"""Contact candidates of hands whose fingers have no inner side, or no points at all."""

from __future__ import annotations

import dataclasses

import torch

from dro_grasp.geometry import se3
from dro_grasp.hands.hand import Hand
from dro_grasp.optimize.contacts import ContactConfig, contact_candidates
from tests.helpers.toy_hand import toy_hand


def with_normals_away(hand: Hand, finger: int) -> Hand:
    """The hand with the normals of one finger pointing away from the grasp centre when half closed."""
    joints = hand.canonical_joints(1 - ContactConfig().closing)
    away = torch.nn.functional.normalize(hand.points(joints) - hand.grasp_centre_wrist, dim=-1)
    rotation = hand.tree.forward(joints)[hand.link_index, :3, :3]
    mine = hand.finger_of_link[hand.link_index] == finger
    return dataclasses.replace(hand, link_normals=torch.where(mine[:, None], se3.rotate(rotation.mT, away), hand.link_normals))


def without_points(hand: Hand, finger: int) -> Hand:
    """The hand without any point on one finger."""
    kept = hand.finger_of_link[hand.link_index] != finger
    return dataclasses.replace(hand, link_points=hand.link_points[kept], link_normals=hand.link_normals[kept],
                               link_index=hand.link_index[kept])


def test_a_finger_without_an_inner_side_may_touch_with_all_of_its_links_that_reach() -> None:
    found = contact_candidates(with_normals_away(toy_hand(), 1))
    assert torch.allclose(found.slot_weights.sum(-1), torch.ones(len(found.slot_finger)))
    drawn = found.draw(200, torch.Generator().manual_seed(0))
    assert set(found.fingers[drawn[:, 1]].tolist()) == {1}


def test_the_slot_of_a_finger_without_points_is_free() -> None:
    found = contact_candidates(without_points(toy_hand(), 1))
    assert torch.allclose(found.slot_weights.sum(-1), torch.ones(len(found.slot_finger)))
    drawn = found.draw(200, torch.Generator().manual_seed(0))
    assert set(found.fingers[drawn[:, 1]].tolist()) >= {0, 2}
