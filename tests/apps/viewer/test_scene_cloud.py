"""What a click hits, and how points of a scene are coloured."""

from __future__ import annotations

import numpy as np
import pytest

from dro_grasp.apps.viewer.scene_cloud import colours_of, first_hit, shades
from dro_grasp.apps.viewer.scene_view import rgb
from dro_grasp.geometry.point_groups import local_normals
from dro_grasp.geometry.rendering.rasterizer import OBJECT_COLOUR
from dro_grasp.objects.perception.segmentation import NOTHING, OTHER, STRUCTURE
from dro_grasp.objects.scenery import load_scene
from dro_grasp.pictures.scene import OBSTACLE_COLOUR, STRAY_COLOUR, STRUCTURE_COLOUR


def test_a_ray_meets_the_first_of_the_points_around_it() -> None:
    """Against points that are looked at one after the other, by their angle to the ray."""
    random = np.random.default_rng(0)
    points = random.uniform((-0.5, -0.5, 1.0), (0.5, 0.5, 2.0), (4000, 3))
    hits = 0
    for _ in range(40):
        direction = random.normal((0, 0, 1), 0.2)
        found = first_hit(points, np.zeros(3), direction, cone=0.02)
        unit = direction / np.linalg.norm(direction)
        inside = [i for i, p in enumerate(points) if np.tan(np.arccos(np.clip(p @ unit / np.linalg.norm(p), -1, 1))) < 0.02]
        assert (found is None) == (not inside)
        if found is not None:
            hits += 1
            assert found in inside
            assert points[found] @ unit < min(points[i] @ unit for i in inside) + 0.03
    assert hits > 20


def test_the_surface_in_front_is_hit_and_not_what_is_behind_it() -> None:
    x, y = np.meshgrid(np.linspace(-0.1, 0.1, 50), np.linspace(-0.1, 0.1, 50))
    front, back = (np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], 1) for z in (0.6, 1.0))
    points = np.concatenate([back, front])
    found = first_hit(points, np.zeros(3), np.array([0.0, 0.0, 3.0]))
    assert found is not None
    assert found >= len(back)
    assert np.hypot(*points[found, :2]) < 0.004
    assert first_hit(points, np.zeros(3), np.array([0.0, 0.0, -1.0])) is None, "behind the eye"


@pytest.mark.parametrize(("points", "direction"), [
    (np.zeros((0, 3)), [0.0, 0, 1]), (np.ones((5, 3)), [0.0, 0, 0]), (np.ones((5, 3)), [np.nan, 0, 1])])
def test_nothing_is_hit_where_there_is_no_point_or_no_ray(points: np.ndarray, direction: list[float]) -> None:
    assert first_hit(points, np.zeros(3), np.array(direction)) is None


def test_colours_say_what_points_were_taken_for() -> None:
    found = colours_of(np.array([0, 3, STRUCTURE, NOTHING, OTHER]))
    assert found.tolist() == [list(rgb(c)) for c in (
        OBSTACLE_COLOUR, OBSTACLE_COLOUR, STRUCTURE_COLOUR, STRAY_COLOUR, STRAY_COLOUR)]
    assert rgb(OBJECT_COLOUR) not in {tuple(row) for row in found.tolist()}


def test_surfaces_are_lit_from_above_and_normals_are_those_of_a_ball() -> None:
    ball = np.random.default_rng(0).normal(size=(4000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    assert np.median(np.abs((local_normals(ball, 24) * ball).sum(1))) > 0.99
    light = shades(np.array([[0.0, 0, 1], [0, 0, -1], [0, 1, 0]]), np.array([0.0, 0, 2]))
    assert light[0] == light[1] == 1.0
    assert light[2] < 0.8
    assert local_normals(ball[:3], 24).shape == (3, 3)


def test_a_place_on_a_thing_means_it_alone() -> None:
    """A small box in the bounding box of a large L: places in both boxes would mean the small one."""
    random = np.random.default_rng(1)
    x, y = np.meshgrid(np.arange(-0.5, 0.5, 0.004), np.arange(-0.4, 0.4, 0.004))
    table = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)

    def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> np.ndarray:
        points = random.uniform(low, high, (9000, 3))
        side, axis = random.integers(2, size=9000), random.integers(3, size=9000)
        points[np.arange(9000), axis] = np.where(side, np.array(high)[axis], np.array(low)[axis])
        return points

    large = np.concatenate([box((-0.12, -0.12, 0.01), (0.12, -0.08, 0.06)), box((-0.12, -0.12, 0.01), (-0.08, 0.12, 0.06))])
    scene = load_scene(np.concatenate([table, large, box((0.0, 0.0, 0.01), (0.06, 0.06, 0.06))]))
    assert scene.segments.count == 2
    assert scene.sight is not None
    for number in range(2):
        chosen = scene.chosen(at=scene.spot(number))
        assert (scene.segments.labels[chosen.own] == number).all()
