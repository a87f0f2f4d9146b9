"""Things that touch, by shapes whose parts are known."""

from __future__ import annotations

import numpy as np
import pytest

import dro_grasp as dro
from dro_grasp.arm.clearing.parts import narrowest, parted
from dro_grasp.arm.tabletop.table_scene import PickedObject
from dro_grasp.objects.loading import cloud_object


def ball(x: float, y: float, radius: float = 0.03, n: int = 2000) -> np.ndarray:
    points = np.random.default_rng(int(1e4 * (x + 7 * y))).normal(size=(n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * radius + np.array([x, y, radius])


def block(size: tuple[float, float, float], x: float = 0.5, y: float = 0.0, n: int = 8000) -> np.ndarray:
    """Points of the top and of the sides."""
    random = np.random.default_rng(0)
    points = random.uniform(-0.5, 0.5, (n, 3)) * size
    face = random.integers(0, 3, n)
    points[np.arange(n), face] = 0.5 * np.array(size)[face] * random.choice([-1, 1], n)
    return points + np.array([x, y, size[2] / 2])


@pytest.mark.parametrize("turn", [0.0, 0.4, 1.3, 2.5])
def test_two_balls_that_touch_are_two(turn: float) -> None:
    way = 0.06 * np.array([np.cos(turn), np.sin(turn)])
    first, second = ball(0.5, 0.0), ball(0.5 + way[0], way[1])
    side = narrowest(np.concatenate([first, second]), 0.0)
    assert side is not None
    own = side[: len(first)].mean(), side[len(first):].mean()
    assert max(own) > 0.93
    assert min(own) < 0.07


def test_one_that_is_nowhere_narrow_is_one() -> None:
    for points in (ball(0.5, 0.1, 0.04), block((0.05, 0.2, 0.04)), block((0.1, 0.1, 0.03)),
                   ball(0.5, 0.1) * (1, 1, 2.0), ball(0.5, 0.0) * (1.0, 1.6, 1.0)):
        assert narrowest(points, 0.0) is None


def test_a_low_thing_and_a_high_one_with_a_gap_are_two_at_any_height_of_the_table() -> None:
    points = np.concatenate([block((0.04, 0.04, 0.15)), ball(0.56, 0.0)]) + np.array([0, 0, 0.3])
    side = narrowest(points, 0.3)
    assert side is not None
    assert abs(int(min(side.sum(), (~side).sum())) - 2000) < 200


def test_each_part_has_the_other_in_its_way_but_not_where_they_touch(robot: dro.Robot) -> None:
    first, second = ball(0.5, 0.0), ball(0.555, 0.0, 0.028)
    picked = PickedObject(cloud_object("both", np.concatenate([first, second]), origin="both", keep_table=True), [], robot)
    parts = parted(picked)
    assert len(parts) == 2
    assert parts[0].obj.cloud[:, 2].max() > parts[1].obj.cloud[:, 2].max()
    for part, x, other in zip(parts, (0.5, 0.555), (0.555, 0.5), strict=True):
        np.testing.assert_allclose(part.obj.cloud.mean(0)[:2], (x, 0.0), atol=0.004)
        (thing,) = part.obstacles
        assert np.sign(other - x) * (thing.cloud[:, 0].mean() - other) > 0, "what is nearest is left out"
        apart = np.linalg.norm(thing.cloud[:, None] - part.obj.cloud[None, ::7], axis=-1).min()
        assert apart > 0.014
    assert parted(PickedObject(cloud_object("one", first, origin="one", keep_table=True), [], robot)) == []
