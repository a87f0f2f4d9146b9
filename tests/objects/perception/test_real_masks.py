"""Masks on recorded frames: what is taken where a thing counts as a board or as too large, and what is refused."""

from __future__ import annotations

import json
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from dro_grasp.errors import ObjectError
from dro_grasp.objects.perception.scene_files import as_camera
from dro_grasp.objects.scenery import Scene, load_scene
from tests.helpers.made_scenes import make_scene
from tests.objects.perception.test_real_frames import FRAMES, matrix

FOLDER = Path(__file__).parent / "real_frames"
SHAPE = (240, 320)
HIGHER = "is higher than its surroundings counts"  # What is said where no thing stands out in a mask


def cameras() -> dict[str, str]:
    """The camera of each frame, as its page states it."""
    page = (FOLDER / "README.md").read_text()
    return {name: text for name, text in re.findall(r"`(\w+)\.json`:?\n+```json\n(.*?)```", page, re.DOTALL)}


@cache
def _scene(name: str, folder: Path) -> Scene:
    (folder / f"{name}.json").write_text(cameras()[name])
    return load_scene(FOLDER / f"{name}.png", camera=folder / f"{name}.json")


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Scene]:
    return {name: _scene(name, tmp_path_factory.getbasetemp()) for name in FRAMES}


def _rectangle(rows: slice, columns: slice) -> np.ndarray:
    mask = np.zeros(SHAPE, bool)
    mask[rows, columns] = True
    return mask


def _inside(scene: Scene, mask: np.ndarray) -> np.ndarray:
    assert scene.sight is not None
    return mask.ravel()[scene.sight.pixels]


@pytest.mark.parametrize("name", FRAMES)
def test_the_page_states_each_camera(name: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(cameras()[name])
    camera = as_camera(path)
    assert camera.depth_unit == FRAMES[name][0]
    assert camera.intrinsics is not None
    np.testing.assert_array_equal(camera.intrinsics, matrix(name))
    assert set(json.loads(path.read_text())) == {"frame", "T_frame_camera", "intrinsics", "depth_unit"}


@pytest.mark.parametrize(("rows", "columns"), [
    (slice(125, 205), slice(84, 130)),  # a box, of which the upper face counts as a board; a rectangle over most of it
    (slice(130, 216), slice(80, 142)),  # all of it, and a part of what lies beside it
    (slice(146, 214), slice(85, 130)),  # its upper face alone
    (slice(80, 135), slice(112, 165)),  # a brush, which is too near to the floor and the box to be a thing by itself
])
def test_a_mask_takes_what_counts_as_a_board_and_no_sliver_of_a_neighbour(
    scenes: dict[str, Scene], rows: slice, columns: slice
) -> None:
    scene, mask = scenes["bin_from_above"], _rectangle(rows, columns)
    found = scene.object_at(mask=mask)
    assert len(found.chosen.own) > 0.8 * _inside(scene, mask).sum()
    assert mask.ravel()[found.chosen.pixels].all(), "and nothing beside the mask"
    assert any(HIGHER in note for note in found.obj.notes)
    assert found.chosen.below is None, "it stands on no plane on which it lies itself"
    assert 0.1 < np.ptp(found.obj.cloud, axis=0).max() < 0.25


def test_the_floor_in_a_mask_is_left_out(scenes: dict[str, Scene]) -> None:
    scene = scenes["bin_from_above"]
    own = scene.chosen(mask=_rectangle(slice(80, 135), slice(112, 165))).own
    assert scene.sight is not None
    inside = _inside(scene, _rectangle(slice(80, 135), slice(112, 165)))
    depth, taken = scene.sight.points[:, 2], np.zeros(len(inside), bool)
    taken[own] = True
    floor = inside & (depth > 0.615)  # [m]
    assert floor.sum() > 100
    assert (floor & taken).sum() < 0.05 * floor.sum()


@pytest.mark.parametrize(("name", "rows", "columns", "told"), [
    ("bin_from_above", slice(170, 214), slice(235, 282), "81 of its 1946 points are on a thing"),  # its floor
    ("tote", slice(60, 200), slice(30, 70), "lies beside what stands out"),  # its left wall
    ("tote", slice(50, 75), slice(120, 190), "points that stand out of tables and walls"),  # its floor
    ("desk", slice(103, 125), slice(95, 175), "points that stand out of tables and walls"),  # the table top
    ("desk", slice(190, 230), slice(140, 190), "points that stand out of tables and walls"),  # the floor
    ("desk", slice(10, 45), slice(170, 240), "points that stand out of tables and walls"),  # a wall
])
def test_masks_over_bare_tables_floors_and_walls_are_refused(
    scenes: dict[str, Scene], name: str, rows: slice, columns: slice, told: str
) -> None:
    with pytest.raises(ObjectError, match=told):
        scenes[name].chosen(mask=_rectangle(rows, columns))


@pytest.mark.parametrize(("name", "rows", "columns"), [
    ("bin_from_above", slice(190, 216), slice(119, 166)),  # a block
    ("desk", slice(68, 108), slice(80, 118)),  # a box on the table
    ("desk", slice(140, 205), slice(25, 75)),  # the back of a chair
    ("tote", slice(160, 190), slice(190, 233)),  # a part of the heap
])
def test_masks_over_what_stands_out_take_it_without_a_word(
    scenes: dict[str, Scene], name: str, rows: slice, columns: slice
) -> None:
    scene, mask = scenes[name], _rectangle(rows, columns)
    chosen = scene.chosen(mask=mask)
    apart = _inside(scene, mask) & (scene.segments.labels != -2)
    assert len(chosen.own) > 0.9 * apart.sum()
    assert not any("mask" in note for note in chosen.notes)


def test_a_raised_face_that_a_mask_shows_beside_a_thing_is_told(scenes: dict[str, Scene]) -> None:
    chosen = scenes["bin_from_above"].chosen(mask=_rectangle(slice(115, 175), slice(200, 280)))
    assert any("also shows a face that is higher than its surroundings" in note for note in chosen.notes)


def test_too_few_points_are_refused_after_what_is_far_from_them_was_left_out() -> None:
    made = make_scene("table", 4, 20, 2, width=320)
    low, high = np.argwhere(made.owner == 2).min(0), np.argwhere(made.owner == 2).max(0) + 1
    mask = np.zeros(made.owner.shape, bool)
    mask[max(0, low[0] - 40):high[0] + 40, max(0, low[1] - 40):high[1] + 40] = True
    mask &= made.owner == -1
    on = np.argwhere(made.owner == 2)
    mask[tuple(on[len(on) // 2:][:2].T)] = True
    with pytest.raises(ObjectError, match=r"the mask has \d points that stand out"):
        made.load().chosen(mask=mask)


@pytest.mark.parametrize(("name", "pixel", "told"), [
    ("bin_from_above", (107, 163), r"shows a table, board or wall\. If the object is there, give .*mask=PNG"),
    ("bin_from_above", (233, 110), r"too large or far away\. If the object is there, give .*mask=PNG.* look from nearer"),
    ("tote", (175, 130), r"something too small\. If the object is there, look from nearer, or give .*mask=PNG"),
    ("tote", (120, 215), r"scattered points\. If the object is there, give .*mask=PNG.* or look from nearer"),
    ("tote", (110, 80), r"no pixel within 12 of 110 80 has a depth; .*mask=PNG"),
])
def test_a_pixel_that_means_no_thing_says_what_to_give_instead(
    scenes: dict[str, Scene], name: str, pixel: tuple[int, int], told: str
) -> None:
    with pytest.raises(ObjectError, match=told):
        scenes[name].chosen(pixel=pixel)
