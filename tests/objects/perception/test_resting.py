"""What rests on a plane touches it: undersides that a camera did not see are completed down to it."""

from __future__ import annotations

import numpy as np
import pytest

from dro_grasp.objects.perception.completion import set_down

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


def test_a_roll_with_a_flattened_underside_becomes_round() -> None:
    points, normals, added = flattened(0.6)
    found, turned = set_down(points, normals, added, TABLE)
    round_points, round_normals, _ = flattened(1.0)
    np.testing.assert_allclose(found, round_points, atol=1e-9)
    np.testing.assert_allclose(turned, round_normals, atol=1e-9)
    np.testing.assert_array_equal(found[~added], points[~added])


@pytest.mark.parametrize("share", [1.0, 0.95, 0.1], ids=["it stands", "nearly", "a guess"])
def test_what_touches_the_plane_or_is_hardly_known_stays(share: float) -> None:
    points, normals, added = flattened(share)
    found, turned = set_down(points, normals, added, TABLE)
    assert found is points
    assert turned is normals


def test_what_was_seen_from_below_floats() -> None:
    """An underside in sight is where it is: nothing that was seen is moved."""
    points, normals, added = flattened(0.6)
    found, _ = set_down(points, normals, np.zeros_like(added), TABLE)
    np.testing.assert_array_equal(found, points)
