"""How deep a grasp is, in the object or in the hand itself, against known overlaps and against a trial."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from dro_grasp.errors import ObjectError
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.perception.partial_views import partial_view
from dro_grasp.simulation.contacts import deepest_penetration
from dro_grasp.simulation.trial import simulate
from tests.helpers.claw import ball, claw, grasps_of, wrist_below


def test_the_deeper_of_object_and_own_links_counts(tmp_path: Path) -> None:
    hand, obj = claw(tmp_path), ball()
    crossed, opened = torch.tensor([[1.3, 1.0] * 4]), torch.zeros(1, 8)
    T = torch.cat([wrist_below(0.5), wrist_below(0.03 + 0.01 - 0.004), wrist_below(0.5)])
    grasps = grasps_of(hand, obj, T, torch.cat([crossed, opened, opened]))
    own, inside, neither = deepest_penetration(hand, obj, grasps).tolist()
    assert own > 0.005, "fingers cross"
    assert inside == pytest.approx(0.004, abs=3e-4), "the ball's lowest point is 4 mm below the palm's face"
    assert neither == 0
    trial = simulate(hand, obj, grasps, "strict")
    torch.testing.assert_close(torch.tensor([own, inside]), torch.stack([trial.self_penetration[0], trial.penetration[1]]))


def test_no_grasps_have_no_depth_and_a_bare_cloud_has_none_either(tmp_path: Path) -> None:
    hand, bare = claw(tmp_path), partial_view(load_object("sphere"), "cloud", 0)
    assert deepest_penetration(hand, ball(), grasps_of(hand, ball(), wrist_below(0.5, 2), torch.zeros(2, 8))[:0]).shape == (0,)
    with pytest.raises(ObjectError, match="bare point cloud"):
        deepest_penetration(hand, bare, grasps_of(hand, bare, wrist_below(0.5), torch.zeros(1, 8)))
