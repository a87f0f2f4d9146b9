"""`hand check` tells and draws the derived facts, and names each fault."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import trimesh

import dro_grasp as dro
from dro_grasp.cli.main import main
from dro_grasp.errors import HandError, OutputError
from dro_grasp.hands.check import check_hand, hand_side, picture
from tests.helpers.bracket_hand import bracket_hand, bracket_urdf
from tests.helpers.claw_urdf import LIMIT, claw, joint, link, meshed, written
from tests.helpers.loaded_hands import loaded_hand


def test_a_lost_mesh_is_named_and_the_rest_is_used(tmp_path: Path) -> None:
    report = check_hand(written(tmp_path, meshed("package://x/lost.stl")))
    assert any(n.subject == "left" and "'package://x/lost.stl' was not found" in n.text for n in report.notes)


def union(*boxes: tuple[tuple[float, float, float], tuple[float, float, float]]) -> trimesh.Trimesh:
    """One mesh of boxes, each by its sizes and its middle."""
    return trimesh.boolean.union([
        trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in boxes], engine="manifold")


def test_a_base_that_its_hull_fills_up_is_told(tmp_path: Path) -> None:
    union(((0.16, 0.06, 0.02), (0, 0, 0)), *(((0.01, 0.06, 0.04), (side * 0.075, 0, 0.015)) for side in (1, -1))).export(
        tmp_path / "u.stl")
    text = claw().replace('<box size="0.08 0.08 0.02"/>', '<mesh filename="u.stl"/>')
    told = [note for note in check_hand(written(tmp_path, text)).notes if "convex hull" in note.text]
    assert [(note.level, note.subject) for note in told] == [("info", "palm")]
    assert not any("convex hull" in note.text for note in check_hand(written(tmp_path, claw(), "plain.urdf")).notes)


def test_a_hand_that_encloses_nothing_as_its_base_is_filled_up_says_so(tmp_path: Path) -> None:
    union(((0.08, 0.03, 0.03), (0, 0, -0.015)), ((0.012, 0.03, 0.08), (-0.034, 0, 0.039))).export(tmp_path / "l.stl")
    limit = '<limit lower="-0.45" upper="0.6" effort="2" velocity="1"/>'
    text = claw(links=link("jaw", '<box size="0.012 0.03 0.08"/>'), joints=joint("a", "palm", "jaw", "0.034 0 0", more=limit))
    with pytest.raises(HandError, match=r"enclose no space.*; palm: taken as the convex hull of its mesh"):
        check_hand(written(tmp_path, text.replace('<box size="0.08 0.08 0.02"/>', '<mesh filename="l.stl"/>')))


def test_a_hand_whose_moving_links_lost_their_meshes_says_which(tmp_path: Path) -> None:
    gone = '<mesh filename="package://x/lost.stl"/>'
    text = claw(links=link("left", gone) + link("right", gone))
    with pytest.raises(HandError, match=r"no fingertip.*package://x/lost.stl' was not found"):
        check_hand(written(tmp_path, text))


def test_a_single_finger_is_warned_of(tmp_path: Path) -> None:
    one = claw(links=link("left"), joints=joint("a", "palm", "left", "-0.035 0 0.01"))
    assert "is the only fingertip" in notes(tmp_path, one)["left"]
    assert not any("only fingertip" in text for text in notes(tmp_path, claw()).values())


def notes(folder: Path, text: str) -> dict[str, str]:
    """Notes of `hand check`, by link or joint."""
    return {note.subject: note.text for note in check_hand(written(folder, text)).notes}


def test_findings_of_the_same_words_are_one_line_for_people_and_one_each_for_programs(tmp_path: Path) -> None:
    drawn = claw(links=link("left", kinds=("visual",)) + link("right", kinds=("visual",)) + link("third")
                 + joint("c", "palm", "third", "0 0.03 0.01", "1 0 0"))
    report = check_hand(written(tmp_path, drawn))
    told = [line for line in report.lines() if "cannot touch anything" in line]
    assert told == ["warning: left, right: has a visual but no collision shape; it cannot touch anything"]
    assert [n["subject"] for n in report.to_dict()["notes"] if "cannot touch" in n["text"]] == ["left", "right"]


def test_check_names_free_coupled_and_unlimited_joints(tmp_path: Path) -> None:
    tip = link("tip")
    joints = (joint("a", "palm", "left", "-0.035 0 0.01", kind="continuous", more="")
              + joint("b", "palm", "right", "0.035 0 0.01", "0 -1 0")
              + joint("c", "right", "tip", "0 0 0.06", "0 -1 0", LIMIT + '<mimic joint="b" multiplier="0.5" offset="0.1"/>'))
    text = claw(links=link("left") + link("right") + tip, joints=joints)
    report = check_hand(written(tmp_path, text))
    assert report.facts["free_joints"] == ["a", "b"]
    assert report.facts["coupled_joints"] == ["c = 0.5 * b + 0.1"]
    assert any(note.subject == "a" and "no limits" in note.text for note in report.notes)
    assert any("free joints" in line and "a, b" in line for line in report.lines())


def test_check_says_what_a_root_called_world_is_called_here(tmp_path: Path) -> None:
    text = claw().replace("</robot>", '<link name="world"/><joint name="stand" type="fixed"><parent link="world"/>'
                                      '<child link="palm"/></joint></robot>')
    assert "'world_link'" in notes(tmp_path, text)["world"]
    hand = dro.load_hand(written(tmp_path, text))
    assert hand.wrist_link == "world_link"


def test_check_names_a_mimic_of_nothing(tmp_path: Path) -> None:
    text = claw(joints=joint("a", "palm", "left", "-0.035 0 0.01", more=LIMIT + '<mimic joint="ghost"/>')
                + joint("b", "palm", "right", "0.035 0 0.01", "0 -1 0"))
    assert "'ghost'" in notes(tmp_path, text)["a"]


def test_check_names_links_that_cannot_collide_or_have_no_volume(tmp_path: Path) -> None:
    assert "cannot touch" in notes(tmp_path, claw(links=link("left", kinds=("visual",)) + link("right")))["left"]
    corners = [[0, 0, 0], [0, 0, 0.06], [0, 0.02, 0.0], [0, 0.02, 0.06]]
    trimesh.Trimesh(corners, [[0, 1, 2], [1, 3, 2]], process=False).export(tmp_path / "flat.stl")
    assert "without volume" in notes(tmp_path, meshed("flat.stl"))["left"]
    trimesh.Trimesh(corners[:3], [[0, 1, 2]], process=False).export(tmp_path / "flat.stl")
    assert "fewer than 4 vertices" in notes(tmp_path, meshed("flat.stl"))["left"]
    assert "no volume" in notes(tmp_path, claw(links=link("left", '<box size="0.01 0.01 0"/>') + link("right")))["left"]


@pytest.mark.parametrize(("side", "name"), [(1.0, "right"), (-1.0, "left")])
def test_sides_of_mirrored_hands(tmp_path: Path, side: float, name: str) -> None:
    assert hand_side(bracket_hand(tmp_path, side)) == name


def test_check_tells_the_anatomy_to_programs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path, bracket_urdf())
    assert main(["hand", "check", str(path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["fingers"] == {
        "distal0": {"links": ["proximal0", "distal0", "pad"], "joints": ["base0", "knuckle0"]},
        "distal1": {"links": ["proximal1", "distal1"], "joints": ["base1", "knuckle1"]},
        "distal2": {"links": ["proximal2", "distal2"], "joints": ["base2", "knuckle2"]},
        "thumb": {"links": ["thumb"], "joints": ["oppose"]},
    }
    assert told["thumb"] == max(told["thumb_opposition"], key=told["thumb_opposition"].get) == "thumb"
    assert told["rigid_groups"] == [["palm", "bracket"], ["proximal0", "pad"]]
    assert set(told["opening_signs"].values()) == {-1}
    assert set(told["open_ends"].values()) == {"lower"}


def test_four_fingers_all_around_have_no_side(tmp_path: Path) -> None:
    """The tip farthest from the others is only by a hair one of them."""
    places = (("0.03 0.03", "-1 1 0"), ("-0.03 0.03", "-1 -1 0"), ("-0.03 -0.03", "1 -1 0"), ("0.031 -0.03", "1 1 0"))
    links = "".join(link(f"f{i}") for i in range(4))
    joints = "".join(joint(f"j{i}", "palm", f"f{i}", f"{xy} 0.01", axis) for i, (xy, axis) in enumerate(places))
    assert hand_side(dro.load_hand(written(tmp_path, claw(links=links, joints=joints)))) == "none"


@pytest.mark.assets
@pytest.mark.parametrize(
    ("name", "side"),
    [("allegro_left", "left"), ("allegro_right", "right"), ("shadowhand", "right"), ("leaphand", "right"),
     ("inspire", "right"), ("ability", "right"), ("orca", "right"), ("barrett", "none")],
)
def test_sides_of_real_hands(assets_folder: Path, name: str, side: str) -> None:
    assert hand_side(loaded_hand(f"assets/{name}")) == side


def test_the_picture_may_be_named_from_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    picture(loaded_hand("gripper3"), "~/hand.png")
    assert (tmp_path / "hand.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(OutputError, match="create it first"):
        picture(loaded_hand("gripper3"), "~/none/hand.png")


def test_the_picture_shows_the_hand_open_and_closed(tmp_path: Path) -> None:
    from PIL import Image

    picture(dro.load_hand(written(tmp_path, claw())), tmp_path / "claw.png")
    with Image.open(tmp_path / "claw.png") as sheet:
        opened, closed = (sheet.crop((x, 30, x + sheet.width // 2, sheet.height - 30)) for x in (0, sheet.width // 2))
        assert opened.tobytes() != closed.tobytes()
        colours = {colour for _, colour in sheet.convert("RGB").getcolors(1 << 24)}
    assert any(r > 150 and g < 60 and b < 60 for r, g, b in colours), "no red arrow"
    assert any(b > 150 and r < 80 and g < 120 for r, g, b in colours), "no blue track"


def test_the_command_says_everything_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path, claw(links=link("left") + link("right", kinds=("visual",))))
    assert main(["hand", "check", str(path), "--picture", str(tmp_path / "claw.png")]) == 0
    said = dict(line.split("  ", 1) for line in capsys.readouterr().out.splitlines() if "  " in line)
    words = {name: value.strip() for name, value in said.items()}
    assert words["palm link"] == "palm"
    assert words["fingertips"] == "left, right"
    assert words["fingers"] == "left (links left; joints a)"
    assert words[""] == "right (links right; joints b)", "each finger has a line of its own"
    assert words["thumb"] == "none"
    assert words["rigid groups"] == "none"
    assert words["opening signs"] == "a -1 (lower), b -1 (lower)"
    assert words["contact links"] == "palm, left"
    assert (tmp_path / "claw.png").read_bytes().startswith(b"\x89PNG")
    assert main(["hand", "check", str(path), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert [n["subject"] for n in report["notes"]] == ["right"]
    assert report["palm_direction"] == pytest.approx([0, 0, 1], abs=0.05)


@pytest.mark.parametrize("text", ["", "no XML", claw(link("left")), claw(links=link("left"))])
def test_the_command_refuses_bad_files_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str
) -> None:
    path = written(tmp_path, text)
    before = path.read_bytes()
    assert main(["hand", "check", str(path), "--picture", str(tmp_path / "claw.png")]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith(f"error: {path}")
    assert said.err.count("\n") == 1
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
