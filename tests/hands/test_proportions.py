"""Proportions against a plain loop."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dro_grasp.hands.proportions import OPENNESS, UNIT, proportions
from dro_grasp.network.placement import PROPORTIONS
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.toy_hand import toy_hand

THUMBS = 6 * 3
"""Where the thumb's tip stands among the numbers of an openness."""


@pytest.mark.parametrize("name", ["gripper3", "allegro"])
def test_they_equal_a_plain_loop(name: str) -> None:
    hand = loaded_hand(name)
    axes = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    found = proportions(hand, torch.from_numpy(axes).float()).numpy()
    assert found.shape == (PROPORTIONS,)
    centre, expected = hand.grasp_centre_wrist.numpy(), []

    def seen(points: list) -> np.ndarray:
        return np.array([axes.T @ (np.asarray(p) - centre) / UNIT for p in points])

    for openness in OPENNESS:
        q = hand.canonical_joints(openness)
        T = hand.tree.forward(q).numpy()
        tips = seen([T[finger.tip, :3, :3] @ offset + T[finger.tip, :3, 3]
                     for finger, offset in zip(hand.fingers, hand.tip_offsets.numpy(), strict=True)])
        of_fingers = {link for finger in hand.fingers for link in finger.links}
        kinds = [int(link) in of_fingers for link in hand.link_index]
        surface = seen([p for p, on in zip(hand.points(q).numpy(), kinds, strict=True) if on])
        thumb = np.zeros(3) if hand.thumb is None else tips[hand.thumb]
        expected += [tips.mean(0), tips.std(0), tips.min(0), tips.max(0), surface.mean(0), surface.std(0), thumb]
    palm = seen([p for p, on in zip(hand.points(hand.canonical_joints(OPENNESS[0])).numpy(), kinds, strict=True) if not on])
    expected += [palm.mean(0), palm.std(0), [len(hand.fingers) / 5, hand.thumb is not None, hand.tree.n_dof / 20]]
    np.testing.assert_allclose(found, np.concatenate(expected), atol=2e-5)


def test_a_hand_without_a_thumb_has_zeros_there() -> None:
    hand = toy_hand()
    found = proportions(hand, torch.eye(3))
    assert hand.thumb is None
    assert bool((found[THUMBS: THUMBS + 3] == 0).all())
    assert bool(found.isfinite().all())
