"""What is seen of an object, by how much of it, and by which seed."""

from __future__ import annotations

import numpy as np
import pytest

from dro_grasp.objects.catalogue import load_object
from dro_grasp.perception.partial_views import POINTS, View, partial_view, visible_side


def test_the_whole_object_is_itself() -> None:
    can = load_object("can")
    assert partial_view(can, "whole", 0) is can


@pytest.mark.parametrize("view", ["half", "depth"])
def test_a_view_is_a_cloud_in_the_objects_frame_that_follows_the_seed(view: View) -> None:
    can = load_object("can")
    once, again, other = (partial_view(can, view, seed).cloud for seed in (3, 3, 4))
    np.testing.assert_array_equal(once, again)
    assert once.shape != other.shape or np.abs(once - other).max() > 0.005
    low, high = can.cloud.min(0) - 0.03, can.cloud.max(0) + 0.03
    assert ((once > low) & (once < high)).mean() > 0.9
    if view == "half":
        assert len(visible_side(can, view, 3)[0]) == POINTS
        assert POINTS < len(once) < 3 * POINTS, "the seen half, thinned, and the other"
