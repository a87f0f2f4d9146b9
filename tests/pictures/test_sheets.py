"""Pictures: the sheet's layout, its captions, and that every part of a grasp is to be seen on it."""

from __future__ import annotations

import dataclasses
import errno
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from dro_grasp.cli import view
from dro_grasp.cli.main import main
from dro_grasp.errors import OptionError, OutputError
from dro_grasp.geometry.rendering.rasterizer import Camera, render
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import complete
from dro_grasp.hands.check import picture
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.perception.partial_views import partial_view
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.pictures import sheets as pictures
from dro_grasp.pictures.appearance import OBJECT_COLOUR, best_camera, hand_meshes, link_colours, object_meshes, success_colour
from dro_grasp.pictures.sheets import (
    CAPTION,
    CONTACT_DISTANCE,
    HEADER,
    TILE,
    PictureStyle,
    caption,
    contact_points,
    draw_grasp,
    draw_grasps,
    heading,
)
from tests.helpers.loaded_hands import loaded_hand


@pytest.fixture(scope="module")
def hand() -> Hand:
    return loaded_hand("gripper3")


@pytest.fixture(scope="module")
def obj() -> ObjectModel:
    return load_object("sphere")


@pytest.fixture(scope="module")
def grasps(hand: Hand, obj: ObjectModel) -> GraspBatch:
    T = torch.eye(4).repeat(3, 1, 1)
    T[:, :3, 3] = -hand.grasp_centre_wrist
    return GraspBatch.create(
        hand, obj, T, hand.canonical_joints(0.6).expand(3, -1), score=torch.tensor([1.0, 0.5, -2.0]),
        success=torch.tensor([True, False, False]), protocol=("dro/1", "dro/1", ""),
    )


def test_sheet_has_a_tile_and_a_dot_of_the_right_colour_per_grasp(hand, obj, grasps, tmp_path: Path) -> None:
    path = tmp_path / "sheet.png"
    draw_grasps(hand, obj, grasps, path, columns=2)
    with Image.open(path) as file:
        picture = np.asarray(file)
    assert picture.shape == (HEADER + 2 * (TILE[1] + CAPTION), 2 * TILE[0], 3)
    for i, outcome in enumerate((True, False, None)):
        x, y = (i % 2) * TILE[0] + 21, HEADER + (i // 2) * (TILE[1] + CAPTION) + TILE[1] + 10
        assert picture[y, x].tolist() == [int(255 * c) for c in success_colour(outcome)]
        tile = picture[y - TILE[1] - 10 : y - 10, x - 21 : x - 21 + TILE[0]]
        assert (tile != 255).any(-1).mean() > 0.1


def test_count_limits_the_tiles(hand, obj, grasps, tmp_path: Path) -> None:
    draw_grasps(hand, obj, grasps, tmp_path / "one.png", count=1)
    with Image.open(tmp_path / "one.png") as picture:
        assert TILE[0] <= picture.size[0] < 2 * TILE[0], "one tile, and room for the title"
        assert picture.size[1] == HEADER + TILE[1] + CAPTION


def test_object_and_every_finger_are_seen(hand, obj, grasps) -> None:
    joints, T = grasps.joints[0], grasps.T_object_wrist[0]
    camera = best_camera(hand, joints, T, obj)
    everything = [*object_meshes(obj), *hand_meshes(hand, joints, T)]
    whole = render(everything, camera, 160, 120)
    for colour in {OBJECT_COLOUR, *link_colours(hand)}:
        without = render([m for m in everything if m.colour != colour], camera, 160, 120)
        assert (whole != without).any(-1).sum() > 30, colour


def test_over_a_table_it_is_seen_from_above(hand, obj, grasps) -> None:
    for grasp in grasps:
        camera = best_camera(hand, grasp.joints[0], grasp.T_object_wrist[0], obj, from_above=True)
        start, target = np.asarray(camera.position), np.asarray(camera.target)
        assert (start - target)[2] / np.linalg.norm(start - target) > 0.29


def test_the_palm_is_not_in_the_way(hand, obj) -> None:
    # Laid on its side, so that the view from behind the palm is one of those to choose from.
    T = torch.eye(4)
    T[:3, :3] = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    T[:3, 3] = -T[:3, :3] @ hand.grasp_centre_wrist
    joints = hand.canonical_joints(0.6)
    points = np.concatenate([hand.points(joints, T).numpy(), obj.cloud])
    chosen = best_camera(hand, joints, T, obj)
    behind = Camera.around(points, tuple((-T[:3, :3] @ hand.palm_direction_wrist).tolist()), field_of_view=0.5)
    shown = []
    for camera in (chosen, behind):
        pictures = [
            render([*hand_meshes(hand, joints, T), *[dataclasses.replace(m, colour=c) for m in object_meshes(obj)]],
                   camera, 160, 120)
            for c in ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
        ]
        shown.append((pictures[0] != pictures[1]).any(-1).sum())
    assert shown[0] > 1.5 * shown[1]
    towards = np.subtract(chosen.position, chosen.target) / np.linalg.norm(np.subtract(chosen.position, chosen.target))
    assert towards @ (T[:3, :3] @ hand.palm_direction_wrist).numpy() > -0.5


def test_clouds_and_hands_without_description_are_drawn_as_points(hand, obj, grasps) -> None:
    bare = ObjectModel("cloud", obj.cloud, obj.cloud_normals, obj.centre_of_mass, "0")
    tensors = Hand.from_tensors(hand.to_tensors())
    picture = draw_grasp(tensors, bare, grasps, 0)
    assert (picture != 255).any(-1).mean() > 0.05


def test_hands_are_drawn_closed_on_a_cloud_too(hand: Hand, obj: ObjectModel, grasps: GraspBatch, tmp_path: Path) -> None:
    cloud = partial_view(obj, "cloud", 0)
    some = complete(hand, grasps[:1], torch.zeros(3))
    closed = pictures.after_closing(hand, cloud, some)
    assert float((closed.joints - some.joints).abs().amax()) > 0.02
    sheets = []
    for posture in ("held", "grasp"):
        draw_grasps(hand, cloud, some, tmp_path / posture, style=PictureStyle(posture=posture))
        sheets.append(np.asarray(Image.open(tmp_path / posture).convert("RGB"))[HEADER:, :TILE[0]])
    assert (sheets[0] != sheets[1]).any(-1).mean() > 0.01


def test_links_above_the_palm_can_be_left_out(hand, grasps) -> None:
    first = hand.tree.parent.index(hand.palm)
    elsewhere = dataclasses.replace(hand, palm=first)
    everything, below = (hand_meshes(elsewhere, grasps.joints[0], above_palm=above) for above in (True, False))
    shapes = [g for g in hand.description.geometry if g.visual]
    assert len(everything) == len(shapes)
    assert len(below) == sum(bool(hand.tree.descends[g.link, first]) for g in shapes) < len(everything)


def test_fingers_are_counted_from_the_palm_on(hand) -> None:
    fingers = hand.finger_of_link.tolist()
    assert fingers[hand.palm] == -1
    assert sorted({fingers[tip] for tip in hand.tips}) == [0, 1, 2]


def test_captions_and_heading_tell_what_was_tried(hand, obj, grasps) -> None:
    assert [caption(grasps, i)[1] for i in range(3)] == [True, False, None]
    assert "confidence 73 %" in caption(grasps, 0)[0]
    carrying = grasps.replace(payload=torch.tensor([0.8, torch.nan, 0.03]))
    assert [caption(carrying, i)[0].split("   ")[-1] for i in (0, 2)] == ["carries 0.8 kg", "carries 0.03 kg"]
    assert "carries" not in caption(carrying, 1)[0]
    assert heading(hand, obj, grasps) == "gripper3 on sphere: 3 grasps, 1 of 2 succeeded (dro/1)"
    untried = grasps.without_trial()
    assert heading(hand, obj, untried) == "gripper3 on sphere: 3 grasps"
    assert heading(hand, obj, untried[:1]) == "gripper3 on sphere: 1 grasp"


def test_a_picture_that_cannot_be_finished_leaves_the_old_one(
    hand, obj, grasps, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(image: Image.Image, file: str | Path, **options: object) -> None:
        Path(file).write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    path = tmp_path / "a.png"
    path.write_bytes(b"the old one")
    monkeypatch.setattr(Image.Image, "save", full)
    with pytest.raises(OutputError, match="No space left"):
        draw_grasps(hand, obj, grasps, path, count=1)
    with pytest.raises(OutputError, match="No space left"):
        picture(hand, path)
    assert path.read_bytes() == b"the old one"
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]


def test_unwritable_path_and_no_grasps_are_refused(hand, obj, grasps, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="nowhere"):
        draw_grasps(hand, obj, grasps, tmp_path / "nowhere" / "a.png", count=1)
    with pytest.raises(OutputError, match="no grasp"):
        draw_grasps(hand, obj, grasps[slice(0, 0)], tmp_path / "a.png")


def test_pictures_of_nothing_are_refused(hand, obj, grasps, tmp_path: Path) -> None:
    for wrong, told in (({"columns": -2}, "columns is -2"), ({"columns": 0}, "columns is 0"), ({"count": -1}, "count is -1")):
        with pytest.raises(OptionError, match=told):
            draw_grasps(hand, obj, grasps, tmp_path / "a.png", **wrong)
    for style, told in (({"size": (0, 0)}, r"size is \(0, 0\)"), ({"opacity": 5.0}, r"opacity is 5\.0")):
        with pytest.raises(OptionError, match=told):
            PictureStyle(**style)
    assert not (tmp_path / "a.png").exists()


def test_a_transparent_object_is_between_none_and_a_solid_one(hand, obj, grasps) -> None:
    solid, half, none = (draw_grasp(hand, obj, grasps, 0, PictureStyle(opacity=a)).astype(int) for a in (1.0, 0.5, 0.0))
    assert np.abs(2 * half - solid - none).max() <= 2
    assert (np.abs(solid - none).max(-1) > 20).mean() > 0.02, "the object fills a part of the picture"


def test_contact_points_lie_on_the_ball(hand, obj, grasps) -> None:
    near = contact_points(hand, obj, grasps.joints[0], grasps.T_object_wrist[0])
    points = hand.points(grasps.joints[0], grasps.T_object_wrist[0]).numpy()
    radius = np.linalg.norm(obj.vertices, axis=1).mean()
    expected = np.abs(np.linalg.norm(points, axis=1) - radius) < CONTACT_DISTANCE
    assert abs(len(near) - expected.sum()) <= 0.4 * expected.sum() + 3
    assert (np.abs(np.linalg.norm(near, axis=1) - radius) < CONTACT_DISTANCE + 0.001).all()
    marked = draw_grasp(hand, obj, grasps, 0, PictureStyle(contacts=True, size=(64, 48)))
    assert marked.shape == (48, 64, 3)
    bare = contact_points(
        hand, dataclasses.replace(obj, vertices=None, faces=None), grasps.joints[0], grasps.T_object_wrist[0])
    assert abs(len(bare) - expected.sum()) <= 0.4 * expected.sum() + 3, "of a cloud as well"


@pytest.fixture(scope="module")
def file(grasps: GraspBatch, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pictures") / "grasps.parquet"
    grasps.save(path)
    return path


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--count", "0"], "error: count is 0; give at least 1 (--count)\n"),
        (["--columns", "-1"], "error: columns is -1; give at least 1 (--columns)\n"),
        (["--size", "100000", "100000"],
         "error: size is (100000, 100000); give a width and a height of 1 to 4096 pixels (--size)\n"),
        (["--size", "0", "100"], "error: size is (0, 100); "),
        (["--opacity", "nan"], "error: opacity is nan; give a number from 0 to 1 (--opacity)\n"),
        (["--output", "p.svg"], "p.svg: give a name that ends in .png, such as p.png\n"),
        (["--output", "p"], "p: give a name that ends in .png"),
    ],
)
def test_the_command_names_the_option_that_is_wrong(
    file: Path, arguments: list[str], word: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(file.parent)
    monkeypatch.setattr(pictures, "draw_grasps", None)
    assert main(["picture", file.name, "--output", "p.png", *arguments]) == 2
    assert word in capsys.readouterr().err
    assert [p.name for p in file.parent.iterdir()] == [file.name]


def test_a_sheet_of_too_many_pixels_is_refused(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(view, "MAX_PIXELS", 3 * 64 * 48 - 1)
    given = ["picture", str(file), "--output", str(file.parent / "Sheet.PNG"), "--size", "64", "48"]
    assert main(given) == 2
    assert "3 pictures of 64 x 48 are" in capsys.readouterr().err
    assert main([*given, "--count", "2"]) == 0


def test_a_long_title_over_few_pictures_is_not_cut() -> None:
    tile = np.full((20, 30, 3), 200, np.uint8)
    sheets = [np.asarray(pictures.contact_sheet([tile], [("0", None)], title)) for title in ("a" * 60, "a" * 120)]
    inked = [int(np.flatnonzero((sheet[:HEADER] < 200).any((0, 2))).max()) for sheet in sheets]
    assert inked[1] > 1.9 * inked[0], "all of its letters are there"
    assert all(right < sheet.shape[1] - 8 for right, sheet in zip(inked, sheets, strict=True))


def test_a_long_caption_is_not_cut_and_does_not_run_into_its_neighbour() -> None:
    tiles, text = [np.full((30, 60, 3), 255, np.uint8)] * 2, "11   success   confidence 97 %   carries 0.99 kg"
    alone = np.asarray(pictures.contact_sheet(tiles[:1], [(text, True)], ""))[-CAPTION:]
    beside = np.asarray(pictures.contact_sheet(tiles, [(text, True), (text, True)], "", columns=2))[-CAPTION:]
    assert (alone[:, -8:] == 255).all()
    assert np.array_equal(beside, np.concatenate([alone, alone], 1))
