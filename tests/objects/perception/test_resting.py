"""What rests on a plane touches it: undersides that a camera did not see are completed down to it."""

from __future__ import annotations

import numpy as np
import pytest

from dro_grasp.objects.perception.completion import HOLLOW, complete_cloud, set_down

RADIUS = 0.035
TABLE = np.array([0.0, 0.0, 2.0, 0.2])  # at z = 0.1; the normal's length does not count


def flattened(share: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, normals and which are added of a lying roll, whose lower half is completed with a share of its depth."""
    angle, along = np.meshgrid(np.linspace(0, 2 * np.pi, 400, endpoint=False), np.linspace(-0.05, 0.05, 9))
    x, z = RADIUS * np.cos(angle).ravel(), RADIUS * np.sin(angle).ravel()
    added = z < -1e-9
    depth = np.where(added, share, 1.0)
    normals = np.stack([x, 0 * x, z / depth], 1)
    points = np.stack([x, along.ravel(), 0.1 + RADIUS + z * depth], 1)
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True), added


@pytest.mark.parametrize("share", [0.6, 0.2])
def test_a_roll_with_a_flattened_underside_becomes_round(share: float) -> None:
    points, normals, added = flattened(share)
    found, turned = set_down(points, normals, added, TABLE, 1.0)
    round_points, round_normals, _ = flattened(1.0)
    np.testing.assert_allclose(found, round_points, atol=1.5e-3)
    assert (turned * round_normals).sum(1).min() > 0.99
    np.testing.assert_array_equal(found[~added], points[~added])


def test_a_lid_seen_straight_from_above_gets_the_whole_body_below_it() -> None:
    """Of a block nothing but the top is seen, and the completion guesses a board: it becomes the block."""
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(-0.03, 0.03, 20), np.linspace(-0.03, 0.03, 20)))
    top = np.stack([x, y, np.full_like(x, 0.2)], 1)  # a tenth of a metre above the table
    edge = np.abs(top[:, :2]).max(1) > 0.0299
    sides = np.concatenate([top[edge] - [0, 0, depth] for depth in (0.01, 0.02, 0.03)])
    points = np.concatenate([top, sides, top - [0, 0, 0.04]])
    added = np.arange(len(points)) >= len(top)
    found, _ = set_down(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)), added, TABLE, 1.0)
    assert found[:, 2].min() == pytest.approx(0.1)
    assert found[added, 2].max() == pytest.approx(0.19, abs=1e-3)
    np.testing.assert_array_equal(found[:, :2], points[:, :2])


@pytest.mark.parametrize(
    ("share", "most"), [(1.0, 1.0), (0.95, 1.0), (0.1, HOLLOW)], ids=["it stands", "nearly", "on something"])
def test_what_touches_the_plane_or_may_stand_on_something_else_stays(share: float, most: float) -> None:
    points, normals, added = flattened(share)
    found, turned = set_down(points, normals, added, TABLE, most)
    assert found is points
    assert turned is normals


def test_what_was_seen_from_below_floats() -> None:
    """An underside in sight is where it is: nothing that was seen is moved."""
    points, normals, added = flattened(0.6)
    found, _ = set_down(points, normals, np.zeros_like(added), TABLE, 1.0)
    np.testing.assert_array_equal(found, points)


@pytest.mark.parametrize("degrees", [0, 10, 40])
def test_a_disc_high_above_a_table_is_the_end_of_a_post_for_a_camera_above_it(degrees: int) -> None:
    """From the side the camera would have seen the post: there it stays a disc on whatever holds it."""
    radius, turn = 0.04 * np.sqrt(np.linspace(0, 1, 900)), 2.4 * np.arange(900)
    disc = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full(900, 0.15)], 1)
    camera = 0.6 * np.array([np.sin(np.radians(degrees)), 0.0, np.cos(np.radians(degrees))]) + [0, 0, 0.15]
    table, up = np.array([0.0, 0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    whole = complete_cloud(disc, np.tile(up, (900, 1)), camera, up, table=table)
    lowest = whole.points[:, 2].min()
    assert lowest == pytest.approx(0.0, abs=1e-6) if degrees < 20 else lowest > 0.05
