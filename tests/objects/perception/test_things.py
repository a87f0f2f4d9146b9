"""Scenes: several things on a table are no object, and the message says where each is."""

from __future__ import annotations

import numpy as np
import pytest

from dro_grasp.errors import ObjectError
from dro_grasp.geometry.point_groups import separate_groups
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.perception.scan import scanned_object

PLACES = ((-0.15, 0.0), (0.12, 0.1), (0.1, -0.16))
SIDES = (0.06, 0.05, 0.04)


def box(side: float, at: tuple[float, float]) -> np.ndarray:
    """Points on the faces of a cube that stands on z = 0."""
    rng = np.random.default_rng(int(1000 * side))
    points, axis = rng.uniform(-0.5, 0.5, (900, 3)), rng.integers(3, size=900)
    points[np.arange(900), axis] = np.copysign(0.5, points[np.arange(900), axis])
    return side * (points + np.array([0, 0, 0.5])) + np.array([*at, 0])


def view(count: int, strays: int = 0) -> np.ndarray:
    """So many cubes on a table of 70 cm, and points that a camera scatters [m]."""
    rng = np.random.default_rng(1)
    table = np.column_stack([rng.uniform(-0.35, 0.35, (5000, 2)), rng.normal(0, 0.001, 5000)])
    far = np.column_stack([rng.uniform(-0.3, 0.3, (strays, 2)), rng.uniform(0.15, 0.3, strays)])
    return np.concatenate([table, far, *(box(side, at) for side, at in zip(SIDES[:count], PLACES, strict=False))])


def from_a_camera(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same in the frame of a camera 80 cm above that looks down, and its pose."""
    T = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.8], [0, 0, 0, 1]])
    return (points - T[:3, 3]) @ T[:3, :3], T


@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("camera", [False, True])
def test_several_things_on_a_table_are_asked_about_with_their_places(count: int, camera: bool) -> None:
    read = (lambda p: scanned_object("view", *from_a_camera(p))) if camera else load_object
    with pytest.raises(ObjectError, match=rf"a view of a table with {count} things .*keep_table=True") as caught:
        read(view(count))
    told = str(caught.value).partition("(")[2].partition(")")[0].split("; ")
    assert len(told) == count
    assert told[0].startswith("6 x 6 x 6 cm about -0.15 0.0")


@pytest.mark.parametrize("camera", [False, True])
def test_one_thing_on_a_table_is_cut_out_without_what_is_scattered_beside_it(camera: bool) -> None:
    points = view(1, strays=30)
    obj = scanned_object("view", *from_a_camera(points), complete=False) if camera else load_object(points)
    assert np.abs(np.median(obj.cloud[:, :2], axis=0) - PLACES[0]).max() < 0.01
    assert np.ptp(obj.cloud, axis=0).max() < 0.065
    assert any("scattered points beside it were left out" in note for note in obj.notes)


def test_things_stay_one_object_where_that_is_asked_and_are_told_where_there_is_no_table() -> None:
    kept = load_object(view(3), keep_table=True)
    assert np.ptp(kept.cloud, axis=0).max() > 0.6
    pair = np.concatenate([box(0.05, (0, 0)), box(0.05, (0.1, 0))])
    assert any("it is 2 things that stand apart (5 x 5 x 5 cm" in note for note in load_object(pair).notes)
    assert not any("apart" in note for note in load_object(box(0.05, (0, 0))).notes)


def test_a_view_of_a_room_is_called_one() -> None:
    rng = np.random.default_rng(0)
    for size, told in ((3.0, True), (300.0, False)):
        points = size * rng.uniform(-0.5, 0.5, (3000, 3))
        with pytest.raises(ObjectError, match="too large") as caught:
            load_object(points)
        assert ("a camera's view in metres, give it as a scene" in str(caught.value)) == told


def test_groups_are_what_stands_apart_however_sparse_the_points_are() -> None:
    for step in (1, 9):
        points = np.concatenate([box(0.05, (0, 0))[::step], box(0.04, (0.12, 0))[::step], [[0.5, 0.5, 0.2]]])
        first, second = separate_groups(points)
        assert len(first) == len(second) == len(box(0.05, (0, 0))[::step])
        assert set(first) | set(second) == set(range(len(points) - 1))
    assert len(separate_groups(np.zeros((5, 3)))) <= 1
    assert [len(group) for group in separate_groups(1e6 * box(1.0, (0, 0)))] == [900]
