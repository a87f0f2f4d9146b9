"""Scenes with known labels: what is found of the object that is asked for, and what is said where it is uncertain."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from dro_grasp.cli.remote import sent_camera
from dro_grasp.errors import ObjectError, OptionError
from dro_grasp.frames import read_motion
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.perception.scan import depth_points, scanned_object
from dro_grasp.objects.perception.scene_files import SceneCamera, as_camera, read_mask
from dro_grasp.objects.perception.segmentation import STRUCTURE
from dro_grasp.objects.perception.taking import taken_object
from dro_grasp.objects.scenery import load_scene
from dro_grasp.pictures.scene import draw_scene
from tests.helpers.made_scenes import MadeScene, looking, make_scene, overlap, render_scene

WELL = 0.9  # Intersection over union of an object that is found


def _table(*middles: tuple[float, float], height: float = 0.1, spacing: float = 0.004) -> np.ndarray:
    """A table of 0.8 x 0.6 m at z = 0, seen from all sides, with boxes of 6 cm."""
    x, y = np.meshgrid(np.arange(-0.4, 0.4, spacing), np.arange(-0.3, 0.3, spacing))
    parts = [np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)]
    for middle in middles:
        box = trimesh.creation.box((0.06, 0.06, height))
        box.apply_translation((*middle, height / 2))
        parts.append(np.asarray(trimesh.sample.sample_surface(box, 4000, seed=0)[0]))
    return np.concatenate(parts)


@pytest.mark.parametrize(("place", "seed", "view"), [("table", 15, 1), ("shelf", 16, 2), ("bin", 14, 1)])
def test_each_object_is_found_by_its_place_and_all_else_is_avoided(place: str, seed: int, view: int) -> None:
    made = make_scene(place, 4, seed, view, width=480)  # type: ignore[arg-type]
    scene = made.load()
    found = [scene.chosen(at=tuple(middle)) for middle in made.middles]
    assert len(found) >= 3
    for k, chosen in enumerate(found):
        assert overlap(made, k, chosen.pixels) > WELL
        others = [i for i in range(len(found)) if i != k]
        assert scene.sight is not None
        avoided = made.owner.ravel()[scene.sight.pixels[chosen.others]]
        for i in others:  # every other object is an obstacle
            assert (avoided == i).sum() > 0.9 * (made.owner == i).sum()
        assert (avoided == k).sum() < 0.05 * (made.owner == k).sum()


def test_a_pixel_a_mask_and_a_place_mean_the_same_thing() -> None:
    made = make_scene("table", 3, 9, 1, width=480)
    scene = made.load()
    row, column = (int(np.median(x)) for x in np.nonzero(made.owner == 1))
    by_place = scene.chosen(at=tuple(made.middles[1]))
    by_pixel = scene.chosen(pixel=(column, row))
    by_mask = scene.chosen(mask=made.owner == 1)
    assert overlap(made, 1, by_place.pixels) > WELL
    np.testing.assert_array_equal(by_pixel.own, by_place.own)
    assert overlap(made, 1, by_mask.pixels) > WELL


def test_depths_and_masks_of_one_channel_are_taken(tmp_path: Path) -> None:
    """Networks and simulators return (h, w, 1)."""
    made = make_scene("table", 2, 9, 1, width=160)
    camera, depth = _saved(made, tmp_path), np.where(made.depth < 5, made.depth, 0.0)
    np.save(tmp_path / "channel.npy", depth[..., None])
    plain = load_scene(depth, camera=camera)
    for source in (depth[..., None], tmp_path / "channel.npy"):
        scene = load_scene(source, camera=camera)
        np.testing.assert_array_equal(scene.points_seen(), plain.points_seen())
        for mask in (made.owner == 1, (made.owner == 1)[..., None]):
            np.testing.assert_array_equal(
                scene.chosen(mask=mask).own, plain.chosen(mask=made.owner == 1).own)


def test_a_mask_that_a_jpeg_blurs_is_its_brighter_half(tmp_path: Path) -> None:
    mask = np.zeros((96, 128), bool)
    mask[20:70, 30:90] = True
    for kind in ("png", "jpg"):
        Image.fromarray(255 * mask.astype(np.uint8)).save(tmp_path / f"mask.{kind}")
    np.testing.assert_array_equal(read_mask(tmp_path / "mask.png"), mask)
    np.testing.assert_array_equal(read_mask(tmp_path / "mask.jpg"), mask)
    with Image.open(tmp_path / "mask.jpg") as blurred:
        assert (np.array(blurred) != 0).sum() > mask.sum(), "it is blurred"


@pytest.mark.usefixtures("as_users_have_it")
@pytest.mark.parametrize(("given", "told"), [
    ({"T_frame_camera": "camera"}, "T_frame_camera"), ({"T_frame_camera": [[1, 0], [0]]}, "T_frame_camera"),
    ({"depth_unit": "0.001"}, "depth_unit is '0.001'"), ({"depth_unit": True}, "depth_unit is True"),
    ({"intrinsics": "K"}, "intrinsics")])
def test_cameras_of_something_else_are_refused_in_words(given: dict[str, Any], told: str) -> None:
    with pytest.raises((OptionError, ObjectError), match=told):
        SceneCamera(**({"T_frame_camera": np.eye(4)} | given))


@pytest.mark.usefixtures("as_users_have_it")
def test_a_last_row_that_products_of_matrices_leave_is_a_motions(tmp_path: Path) -> None:
    T = np.eye(4)
    T[3] = (1e-9, -2e-8, 0, 1 + 1e-9)
    assert SceneCamera(T, depth_unit=np.float32(0.5)).T_frame_camera[3].tolist() == [0, 0, 0, 1]
    (tmp_path / "pose.json").write_text(json.dumps({"frame": "base", "T_frame_camera": T.tolist()}))
    assert read_motion(tmp_path / "pose.json", "T_frame_camera").T[3].tolist() == [0, 0, 0, 1]


def test_the_nearest_is_the_one_nearest_to_the_camera() -> None:
    made = make_scene("table", 3, 9, 1, width=480)
    depths = [np.nanmin(made.depth[made.owner == k]) for k in range(len(made.names))]
    assert overlap(made, int(np.argmin(depths)), made.load().chosen(nearest=True).pixels) > WELL


def test_the_object_stands_on_its_table_in_the_named_frame() -> None:
    made = make_scene("table", 3, 9, 1, width=480)
    found = made.load().object_at(tuple(made.middles[0]))
    true = load_object(made.names[0])
    table = found.obj.table
    assert table is not None
    np.testing.assert_allclose(table, (0, 0, 1, 0), atol=0.01)  # within noise [m]
    assert found.obj.cloud[:, 2].min() > -0.005
    middle = (found.obj.cloud.min(0) + found.obj.cloud.max(0)) / 2
    assert np.linalg.norm(middle - made.middles[0]) < 0.02
    assert abs(np.ptp(found.obj.cloud[:, 2]) - true.extents[2]) < 0.015
    assert found.obstacles is not None
    # Hands stay above the table by another way: it is no obstacle.
    others = made.owner.ravel()[made.load().sight.pixels[found.chosen.others]] == -1  # type: ignore[union-attr]
    on = np.abs(made.load().sight.world()[found.chosen.others][others, 2]) < 0.015  # type: ignore[union-attr]
    assert on.sum() < 0.01 * (made.owner == -1).sum()


def _saved(made: MadeScene, folder: Path, unit: float | None = None) -> Path:
    camera = {"frame": "world", "T_frame_camera": made.camera.T_frame_camera.tolist(),
              "intrinsics": np.asarray(made.camera.intrinsics).tolist()}
    (folder / "camera.json").write_text(json.dumps(camera | ({} if unit is None else {"depth_unit": unit})))
    return folder / "camera.json"


@pytest.mark.parametrize(("name", "unit"), [("d.png", None), ("d.png", 0.0002), ("d.tiff", None), ("d.npy", None)])
def test_depth_files_give_the_same_points(name: str, unit: float | None, tmp_path: Path) -> None:
    made = make_scene("table", 1, 0, width=160)
    depth = np.where(made.depth < 5, made.depth, np.nan)
    camera = _saved(made, tmp_path, unit)
    if name == "d.npy":
        np.save(tmp_path / name, depth)
    elif name == "d.tiff":
        Image.fromarray(depth.astype(np.float32)).save(tmp_path / name)
    else:
        Image.fromarray(np.nan_to_num(depth / (unit or 0.001)).round().astype(np.uint16)).save(tmp_path / name)
    scene = load_scene(tmp_path / name, camera=camera)
    K = np.asarray(made.camera.intrinsics)
    row, column = np.nonzero(np.isfinite(depth))
    z = depth[row, column]
    true = np.stack([(column - K[0, 2]) * z / K[0, 0], (row - K[1, 2]) * z / K[1, 1], z], 1)
    assert scene.sight is not None
    np.testing.assert_allclose(scene.sight.points, true, atol=0.001)  # [m], of rounding


def test_a_depth_tensor_is_read_whatever_needs_its_gradient(tmp_path: Path) -> None:
    made = make_scene("table", 1, 0, width=160)
    depth = torch.tensor(np.where(made.depth < 5, made.depth, 0.0), requires_grad=True)
    camera = _saved(made, tmp_path)
    scenes = [load_scene(each, camera=camera) for each in (depth, depth.detach().numpy())]
    np.testing.assert_array_equal(*(scene.points_seen() for scene in scenes))


def test_depth_without_intrinsics_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "depth.npy", np.ones((48, 64)))
    with pytest.raises(OptionError, match="give its camera with intrinsics"):
        load_scene(tmp_path / "depth.npy")


def test_an_eight_bit_image_is_no_depth(tmp_path: Path) -> None:
    made = make_scene("table", 1, 0, width=160)
    Image.fromarray(np.zeros((120, 160), np.uint8)).save(tmp_path / "d.png")
    with pytest.raises(ObjectError, match="8 bit a pixel, and is no depth image"):
        load_scene(tmp_path / "d.png", camera=_saved(made, tmp_path))


def test_without_a_choice_the_things_are_listed() -> None:
    scene = load_scene(_table((0.2, 0.1), (-0.2, -0.1)))
    with pytest.raises(ObjectError, match=r"shows 2 things .*at 0\.20 0\.10 0\.0.*at=\(X, Y, Z\).*nearest=True"):
        scene.object_at()
    assert scene.object_at((0.2, 0.1, 0.05)).obj.table is not None


def test_one_thing_needs_no_choice() -> None:
    found = load_scene(_table((0.2, 0.1))).object_at()
    np.testing.assert_allclose(found.obj.cloud[:, :2].mean(0), (0.2, 0.1), atol=0.005)


@pytest.mark.parametrize("make", [list, np.array, np.float32, torch.tensor])
def test_a_place_is_any_kind_of_vector(make: Callable[[Any], Any]) -> None:
    found = load_scene(_table((0.2, 0.1), (-0.2, -0.1))).object_at(make((0.2, 0.1, 0.05)))
    np.testing.assert_allclose(found.obj.cloud[:, :2].mean(0), (0.2, 0.1), atol=0.005)


@pytest.mark.parametrize("make", [list, np.array, torch.tensor])
def test_a_pixel_is_any_kind_of_vector(make: Callable[[Any], Any]) -> None:
    made = make_scene("table", 1, 0, width=320)
    row, column = (int(each[len(each) // 2]) for each in np.nonzero(made.owner == 0))
    assert len(made.load().object_at(pixel=make((column, row))).obj.cloud) > 100


def test_a_place_where_nothing_is_says_what_there_is() -> None:
    with pytest.raises(ObjectError, match=r"no thing within 5 cm of -0\.20 0\.20 0\.00: the nearest is .* cm away"):
        load_scene(_table((0.2, 0.1))).object_at((-0.2, 0.2, 0.0))


def test_level_tops_of_things_that_stand_apart_are_no_board() -> None:
    corner = [(-0.15 + 0.08 * i, -0.15) for i in range(5)] + [(-0.15, -0.07 + 0.08 * i) for i in range(4)]
    segments = load_scene(_table(*corner, spacing=0.003)).segments
    assert (segments.count, len(segments.planes)) == (9, 1)


def test_a_bare_table_shows_nothing() -> None:
    with pytest.raises(ObjectError, match=r"nothing stands out .*1 plane"):
        load_scene(_table()).object_at()


def test_a_pixel_of_the_table_says_so() -> None:
    made = make_scene("table", 1, 0, width=320)
    with pytest.raises(ObjectError, match="shows a table, board or wall"):
        made.load().object_at(pixel=(160, 200) if made.owner[200, 160] == -1 else (60, 200))


def test_two_boxes_that_touch_are_uncertain_and_one_alone_is_not() -> None:
    low, tall = trimesh.creation.box((0.08, 0.14, 0.06)), trimesh.creation.box((0.06, 0.06, 0.16))
    low.apply_translation((0, 0, 0.03))
    tall.apply_translation((0.07, 0, 0.08))
    one, two = (render_scene("table", boxes, ("box",) * len(boxes), np.random.default_rng(0), 2)
                for boxes in ([tall], [low, tall]))
    assert not any("touch" in note for note in one.load().chosen().notes)
    assert any("two things that touch" in note for note in two.load().chosen().notes)


def _large_box() -> MadeScene:
    """Its lid counts as a table: 0.12 m² of it are seen."""
    box = trimesh.creation.box((0.35, 0.35, 0.15))
    box.apply_translation((0, 0, 0.075))
    return render_scene("table", [box], ("box",), np.random.default_rng(0), 2, width=480)


def test_the_side_of_a_large_box_is_told() -> None:
    scene = _large_box().load()
    assert len(scene.segments.planes) == 2
    assert any("one side of a large box" in note for note in scene.chosen().notes)
    assert not any("large box" in note for note in make_scene("table", 1, 0, width=320).load().chosen().notes)


def test_a_mask_says_that_a_level_face_is_of_the_object() -> None:
    made = _large_box()
    scene = made.load()
    chosen = scene.chosen(mask=made.owner == 0)
    assert overlap(made, 0, chosen.pixels) > WELL
    assert not any("large box" in note for note in chosen.notes)
    found = scene.object_at(mask=made.owner == 0)
    assert found.obj.table is not None
    assert abs(found.obj.table[3]) < 0.01, "it stands on the table, not on its lid"


def test_a_large_box_from_straight_above_stands_on_the_table() -> None:
    depth = np.full((240, 320), 1.1)
    depth[60:180, 90:210] = 0.95
    camera = SceneCamera(np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1.1], [0, 0, 0, 1]]),
                         np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]), "world")
    found = load_scene(depth, camera=camera).object_at(mask=depth < 1)
    assert found.obj.table is not None
    np.testing.assert_allclose(found.obj.table, (0, 0, 1, 0), atol=0.01)
    assert found.obj.cloud[:, 2].max() == pytest.approx(0.15, abs=0.01)


@pytest.mark.parametrize("share", [0.6, 0.8, 1.0])
def test_a_loose_mask_takes_no_table(share: float) -> None:
    """A rectangle around the only thing, and much of its table."""
    made = make_scene("table", 1, 0, width=320)
    v, u = (int(np.median(rows)) for rows in np.nonzero(made.owner == 0))
    mask = np.zeros(made.owner.shape, bool)
    half = [int(share * n) for n in mask.shape]
    mask[max(0, v - half[0]):v + half[0], max(0, u - half[1]):u + half[1]] = True
    assert mask.mean() > 0.5
    scene = made.load()
    chosen = scene.chosen(mask=mask)
    assert overlap(made, 0, chosen.pixels) > WELL
    assert scene.sight is not None
    table = np.zeros(mask.size, bool)
    table[scene.sight.pixels[scene.segments.labels == STRUCTURE]] = True
    with pytest.raises(ObjectError, match=r"points that stand out of tables.*too flat to stand out is taken .*plan --mask"):
        scene.chosen(mask=mask & table.reshape(mask.shape))


def test_a_mask_of_another_size_names_its_file_and_both_sizes(tmp_path: Path) -> None:
    scene = make_scene("table", 1, 0, width=160).load()
    Image.fromarray(np.full((60, 80), 255, np.uint8)).save(tmp_path / "m.png")
    with pytest.raises(ObjectError, match=r"the mask .*m\.png has shape \(60, 80\), and what the camera saw, '.*', has "
                       r"\(120, 160\): rows and columns"):
        scene.chosen(mask=tmp_path / "m.png")
    with pytest.raises(ObjectError, match=r"^the mask has shape \(60, 80\), and what the camera saw"):
        scene.chosen(mask=np.ones((60, 80), bool))


def test_what_a_mask_shows_beside_its_thing_is_told() -> None:
    made = make_scene("table", 3, 9, 1, width=480)
    scene = made.load()
    both = scene.chosen(mask=(made.owner == 0) | (made.owner == 1))
    assert any("shows more than one thing" in note for note in both.notes)
    everything = scene.chosen(mask=np.ones_like(made.owner, bool))
    assert any("shows more than one thing" in note for note in everything.notes)
    assert max(overlap(made, k, everything.pixels) for k in range(3)) > WELL, "and no table"
    assert not any("more than one" in note for note in scene.chosen(mask=made.owner == 1).notes)


def test_what_reaches_the_border_is_cut_off() -> None:
    made = make_scene("table", 1, 12, width=480)
    middle = int(np.median(np.nonzero((made.owner == 0).any(0))[0]))
    whole = made.load().chosen()
    assert not any("cut off" in note for note in whole.notes)
    K = np.asarray(made.camera.intrinsics) - [[0, 0, middle], [0, 0, 0], [0, 0, 0]]
    camera = SceneCamera(made.camera.T_frame_camera, K, "world")
    half = load_scene(made.depth[:, middle:], camera=camera).chosen(nearest=True)
    assert any("the image's border and may be cut off" in note for note in half.notes)


def test_a_thing_of_which_nothing_is_left_is_told_with_its_place() -> None:
    down = np.diag([1.0, -1.0, -1.0, 1.0])  # a camera that looks down from 1 m
    scene = load_scene((_table((0.2, 0.1)) - np.array([0, 0, 1])) @ down[:3, :3], camera=SceneCamera(down))
    chosen = scene.chosen(nearest=True)
    assert scene.sight is not None
    over = [*scene.segments.planes[0][:3], scene.segments.planes[0][3] + 0.3]  # a plane above the thing
    segments = replace(scene.segments, planes=(np.array(over),))
    with pytest.raises(ObjectError, match=r"of the thing at 0\.20 .* 0 of .* points are above the plane .*mask=PNG"):
        taken_object("thing", scene.sight, segments, chosen)


def test_two_choices_contradict() -> None:
    with pytest.raises(OptionError, match="at and nearest each say"):
        load_scene(_table((0, 0))).object_at((0, 0, 0), nearest=True)


def test_a_mesh_is_no_view() -> None:
    with pytest.raises(ObjectError, match="is a mesh; give what a camera saw"):
        load_scene(trimesh.creation.box((1, 1, 1))).object_at()


def test_a_scene_given_as_an_object_is_told_apart() -> None:
    # A wall, a table and a thing in 0.9 m: no table is found by its share, and the whole was one object.
    y, z = np.meshgrid(np.arange(-0.3, 0.3, 0.004), np.arange(-0.4, 0.5, 0.004))
    wall = np.stack([np.full(y.size, 0.4), y.ravel(), z.ravel()], 1)
    room = np.concatenate([_table((0.0, 0.0), (-0.2, 0.1)), wall])
    with pytest.raises(ObjectError, match=re.escape("is a scene, and no object") + ".*scene=FILE"):
        load_object(room)
    camera = looking(np.array([-1.0, 0.0, 0.8]), np.zeros(3))
    with pytest.raises(ObjectError, match="scene=FILE"):
        scanned_object("room", (room - camera[:3, 3]) @ camera[:3, :3], camera)
    assert load_object(room, keep_table=True).is_cloud


def test_a_bare_table_is_no_object() -> None:
    with pytest.raises(ObjectError, match=r"a plane of 0\.\d\d m² and nothing on it"):
        load_object(_table())
    assert load_object(_table(), keep_table=True).is_cloud


def test_a_thing_alone_is_an_object() -> None:
    long = trimesh.creation.box((0.9, 0.05, 0.05))
    assert load_object(np.asarray(trimesh.sample.sample_surface(long, 3000, seed=0)[0])).is_cloud


def test_the_picture_shows_object_table_and_obstacles(tmp_path: Path) -> None:
    made = make_scene("table", 3, 9, 1, width=320)
    scene = made.load()
    draw_scene(scene, scene.object_at(tuple(made.middles[0])), tmp_path / "scene.png")
    with Image.open(tmp_path / "scene.png") as image:
        picture = np.asarray(image).astype(int)[:500, :640]
    red, _, blue = np.moveaxis(picture, 2, 0)
    assert (red > blue + 60).sum() > 300  # orange
    assert (blue > red + 60).sum() > 300  # blue
    assert ((np.abs(red - blue) < 25) & (red < 230)).sum() > 5000  # grey


@pytest.mark.parametrize(("entry", "told"), [
    ("depth_scale", "Call it 'depth_unit' if it is the metres of one count"), ("Intrinsics", "Call it 'intrinsics' if it is"),
    ("D", "Leave it out")])
def test_entries_of_a_camera_that_nothing_reads_are_refused(entry: str, told: str, tmp_path: Path) -> None:
    path = _saved(make_scene("table", 1, 0, width=160), tmp_path)
    values = json.loads(path.read_text()) | {entry: 0.00025}
    path.write_text(json.dumps({name: value for name, value in values.items() if name == entry or name != entry.lower()}))
    for read in (as_camera, lambda p: read_motion(p, "T_frame_camera"), sent_camera):
        with pytest.raises(OptionError, match=f"has an entry '{entry}'.*known are frame, T_frame_camera, intrinsics.*{told}"):
            read(path)


def test_scenes_of_a_millimetre_are_refused(tmp_path: Path) -> None:
    made = make_scene("table", 1, 0, width=160)
    depth, camera = np.where(made.depth < 5, made.depth, np.nan), _saved(made, tmp_path)
    Image.fromarray(np.nan_to_num(1000 * depth).round().astype(np.uint16)).save(tmp_path / "d.png")
    with pytest.raises(ObjectError, match=r"nearer than a depth camera .*; times 1000 it is .* leave out a scale"):
        load_scene(tmp_path / "d.png", camera=camera, scale=0.001)
    sight = made.load().sight
    assert sight is not None
    points = sight.points[np.linalg.norm(sight.points, axis=1) < 1.5]
    with pytest.raises(ObjectError, match=r"are 0\.0\d+ m from the camera, nearer than a depth camera measures"):
        load_scene(points, camera=camera, scale=0.001)
    for source in (points, trimesh.creation.box((0.5, 0.3, 0.4))):
        with pytest.raises(ObjectError, match=r"measures .* mm when it is scaled by 0\.001, too little for a hand to meet"):
            load_scene(source, scale=0.001)
    turned = points[:, [2, 0, 1]]  # x forward: many z are near 0
    assert load_scene(turned, camera=camera).sight is not None
    assert np.ptp(load_scene(np.array([[0.1, 0, 0], [0.102, 0, 0]])).points) > 0, "a speck in metres is one"


def test_masks_are_what_is_seen_of_them(tmp_path: Path) -> None:
    on = np.zeros((4, 6), bool)
    on[1:3, 2:4] = True
    label, clear = np.zeros((4, 6, 3), np.uint8), np.full((4, 6, 4), 255, np.uint8)
    label[on], clear[~on, 3] = (0, 0, 4), 0
    for name, pixels in (("label", label), ("clear", clear), ("grey", on.astype(np.uint8))):
        Image.fromarray(pixels).save(tmp_path / f"{name}.png")
        np.testing.assert_array_equal(read_mask(tmp_path / f"{name}.png"), on)
    K = [[5, 0, 2.5], [0, 5, 1.5], [0, 0, 1]]
    points = depth_points(np.full((4, 6), 0.5), K, np.where(on, 1.0, np.nan))
    assert len(points) == on.sum()


@pytest.mark.usefixtures("as_users_have_it")
def test_a_camera_of_lists_is_one_of_arrays() -> None:
    made = make_scene("table", 1, 0, width=160)
    K = np.asarray(made.camera.intrinsics)
    camera = SceneCamera(np.eye(4).tolist(), K.tolist())  # type: ignore[arg-type]
    assert load_scene(np.where(made.depth < 5, made.depth, 0.0), camera=camera).segments.count == 1
    with pytest.raises(OptionError, match=r"intrinsics have shape \(3, 4\)"):
        SceneCamera(np.eye(4), np.ones((3, 4)))
