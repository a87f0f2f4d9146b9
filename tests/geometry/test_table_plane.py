"""Tables in clouds: found where there is one, with its pose known, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dro_grasp.geometry.table_plane import LEAST_THICK, above_plane, largest_plane, moved_plane, table_plane
from dro_grasp.objects.catalogue import load_object


def on_table(name: str, side: float, noise: float = 0.001) -> tuple[np.ndarray, int]:
    """An object on a square table at its foot, with its number of points; the object comes first."""
    rng = np.random.default_rng(0)
    obj = load_object(name).cloud[::8].astype(np.float64)
    table = np.column_stack([rng.uniform(-side / 2, side / 2, (3000, 2)), np.full(3000, obj[:, 2].min())])
    points = np.concatenate([obj, table])
    return points + rng.normal(0, noise, points.shape), len(obj)


@pytest.mark.parametrize("name", ["soap", "mug", "cube", "wrench"])
def test_a_table_is_found_in_any_pose(name: str) -> None:
    points, own = on_table(name, 0.5)
    R, t = Rotation.random(random_state=3).as_matrix(), np.array([0.3, -0.2, 0.7])
    plane = table_plane(points @ R.T + t)
    assert plane is not None
    assert np.degrees(np.arccos(np.clip(plane[:3] @ R[:, 2], -1, 1))) < 2
    foot = R @ [0, 0, load_object(name).cloud[:, 2].min()] + t
    assert abs(foot @ plane[:3] - plane[3]) < 0.003  # [m]
    kept = above_plane(points @ R.T + t, plane)
    higher = points[:own, 2] > points[:own, 2].min() + 6 * LEAST_THICK
    assert kept[:own][higher].all()
    assert kept[own:].mean() < 0.001


@pytest.mark.parametrize("noise", [0.0, 0.003, 0.006])
def test_as_much_is_cut_as_the_points_scatter(noise: float) -> None:
    points, own = on_table("cube", 0.6, noise)
    plane = table_plane(points)
    assert plane is not None
    assert abs(plane[3] - load_object("cube").cloud[:, 2].min()) < 0.002
    kept = above_plane(points, plane)
    assert kept[own:].mean() < 0.004, "all but what is beyond three deviations"
    higher = points[:own, 2] - plane[3] > max(LEAST_THICK, 4 * noise)
    assert kept[:own][higher].all()
    if noise == 0:
        assert kept[:own].mean() > 0.77, "little but its foot, a sixth, is lost"


def test_points_stay_on_a_plane_that_is_moved_with_them() -> None:
    rng, T = np.random.default_rng(1), np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.random(random_state=5).as_matrix(), (0.3, -0.2, 0.7)
    normal = np.array([0.6, 0.0, 0.8])
    across = np.array([[0.0, 1.0, 0.0], [0.8, 0.0, -0.6]])
    points = 0.25 * normal + rng.uniform(-1, 1, (20, 2)) @ across
    plane = moved_plane(np.append(normal, 0.25), T)
    assert np.allclose((points @ T[:3, :3].T + T[:3, 3]) @ plane[:3], plane[3])
    assert np.allclose(plane[:3], T[:3, :3] @ normal)


def test_a_table_is_seen_from_above() -> None:
    points, _ = on_table("mug", 0.5)
    above = table_plane(points, np.array([0.2, 0.0, 1.0]))
    assert above is not None
    assert above[2] > 0.99
    assert table_plane(points, np.array([0.2, 0.0, -1.0])) is None


@pytest.mark.parametrize("name", ["flat_box", "soap", "bowl", "tin", "toy_airplane", "wine_glass"])
def test_no_object_is_a_table(name: str) -> None:
    cloud = load_object(name).cloud.astype(np.float64)
    assert table_plane(cloud) is None
    for axis in range(3):
        half = cloud[cloud[:, axis] > np.median(cloud[:, axis])]
        assert table_plane(half) is None


def test_what_a_camera_scatters_hides_no_table_and_many_things_on_it_do_not() -> None:
    rng = np.random.default_rng(0)
    points, _ = on_table("soap", 0.6)
    below = np.column_stack([rng.uniform(-0.3, 0.3, (60, 2)), points[:, 2].min() - rng.uniform(0.02, 0.1, 60)])
    beside = np.column_stack([rng.uniform(-0.3, 0.3, (40, 2)), points[:, 2].min() + rng.uniform(0.02, 0.3, 40)])
    assert table_plane(np.concatenate([points, below, beside])) is not None
    things = [points[:-3000] + np.array([x, y, 0]) for x in (-0.22, 0.22) for y in (-0.22, 0.22)]  # their hull is the table's
    assert table_plane(np.concatenate([*things, points[-3000:]])) is not None


def test_too_little_is_no_table() -> None:
    assert table_plane(np.zeros((100, 3))) is None
    assert table_plane(np.zeros((3, 3))) is None
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(-0.2, 0.2, (500, 2)), np.zeros(500)])
    assert table_plane(flat) is None, "nothing stands on it"


def test_the_largest_plane_is_level_where_that_is_asked() -> None:
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.normal(0.3, 0.001, 2000), rng.uniform(-0.5, 0.5, (2000, 2))])
    tilted = np.column_stack([rng.uniform(-0.5, 0.5, (1000, 2)), rng.normal(0, 0.001, 1000)])
    tilted[:, 2] += 0.1 + 0.1 * tilted[:, 1]
    points = np.concatenate([wall, tilted])
    by_hand = np.linalg.lstsq(np.c_[tilted[:, :2], np.ones(1000)], tilted[:, 2], rcond=None)[0]
    expected = np.array([-by_hand[0], -by_hand[1], 1, by_hand[2]]) / np.linalg.norm([*by_hand[:2], 1])
    upright, level = largest_plane(points, 0.005), largest_plane(points, 0.005, steepest=0.2)
    assert upright is not None
    assert level is not None
    assert np.abs(upright[:3]) @ [1, 0, 0] > 0.9999
    assert np.allclose(level, expected, atol=1e-3)
    assert largest_plane(np.zeros((2, 3)), 0.005) is None
