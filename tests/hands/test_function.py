"""Palm, thumb, side and opening follow from what fingers do, whatever limits and names say; doubts are told."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch

import dro_grasp as dro
from dro_grasp.hands.build import HandBuilder
from dro_grasp.hands.check import HandReport, check_hand, picture
from dro_grasp.hands.confidence import LOW
from dro_grasp.hands.library import load_hand_description
from tests.helpers.claw_urdf import written
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.strange_hands import QUARTER, block, finger, fixed, human, jaws, ring, robot, sliding, thumb_hinges, tripod

SIDES = {1: "right", -1: "left"}


def checked(folder: Path, text: str, name: str = "hand.urdf") -> HandReport:
    return check_hand(written(folder, text, name))


def signs(report: HandReport, *names: str) -> list[int]:
    return [report.facts["opening_signs"][name] for name in names]


def doubts(report: HandReport) -> list[str]:
    return [note.text for note in report.notes if note.level == "warning"]


@pytest.mark.parametrize("given", [
    {}, {"turned": (-1, 1, -1)}, {"turned": (1, -1, -1), "coupled": True}, {"base": (0, QUARTER), "lengths": (0.09, 0.07)},
    {"base": (-1.05, 1.05), "bend": 1.8, "turned": (-1, -1, 1), "apart": 0.04}, {"bend": 1.3, "coupled": True}])
def test_three_fingers_that_bend_as_far_back_as_forth_close_towards_each_other(tmp_path: Path, given: dict) -> None:
    report = checked(tmp_path, tripod(**given))
    assert report.facts["palm_direction"] == pytest.approx([0, 0, 1], abs=0.3)
    for name, way in zip("tab", given.get("turned", (1, 1, 1)), strict=True):
        assert signs(report, f"{name}_0", f"{name}_1") == [-way, -way]
        assert report.facts["open_posture"][f"{name}_1"] == pytest.approx(0, abs=0.1), "straight, not rolled up"
    bases = ["a_base"] if given.get("coupled") else ["a_base", "b_base"]
    assert report.facts["spreading_joints"] == bases
    lower, upper = given.get("base", (-QUARTER, QUARTER))
    assert all(lower + 0.2 < report.facts["open_posture"][name] < upper - 0.2 for name in bases)
    assert report.facts["confidence"]["palm"] > LOW


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("back", [0.0, 0.2])
@pytest.mark.parametrize("first", ["yaw", "roll", None])
def test_a_thumb_that_folds_back_opens_straight(tmp_path: Path, first: str | None, back: float, side: int) -> None:
    turns = {"yaw": ("thumb_yaw", f"0 0 {side}", -1.3, 0.2, 0.02), "roll": ("thumb_roll", f"0 0 {side}", -0.6, 1.0, 0.015)}
    hinges = [turns[name] for name in (first,) if name] + thumb_hinges(QUARTER, QUARTER)
    report = checked(tmp_path, human(hinges, side=side, back=back))
    assert report.facts["palm_direction"] == pytest.approx([1, 0, 0], abs=0.3)
    assert (report.facts["thumb"], report.facts["side"]) == (f"thumb{2 + bool(first)}", SIDES[side])
    assert signs(report, "thumb_mcp", "thumb_ip", "index_mcp", "little_pip") == [-1] * 4
    assert abs(report.facts["open_posture"]["thumb_ip"]) < 0.1
    assert report.facts["open_posture"]["thumb_mcp"] > -1.0
    assert report.facts["open_posture"]["index_pip"] == pytest.approx(-back, abs=1e-3)
    assert not doubts(report)


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(("spread", "tilt", "after"), [
    ((-0.35, 0.35), 0.0, False), ((-0.35, 0.35), 0.85, False), ((-0.2, 0.5), -0.7, False), ((-0.35, 0.35), 0.0, True)])
def test_joints_that_move_fingertips_aside_spread_whatever_their_axis(
    tmp_path: Path, spread: tuple[float, float], tilt: float, after: bool, side: int
) -> None:
    report = checked(tmp_path, human(spread=spread, tilt=tilt, after=after, side=side))
    names = [f"{name}_AA" for name in ("index", "middle", "ring", "little")]
    assert report.facts["spreading_joints"] == names
    assert [report.facts["open_posture"][name] for name in names] == pytest.approx([0.0] * 4, abs=1e-3)
    assert (report.facts["thumb"], report.facts["side"]) == ("thumb3", SIDES[side])


@pytest.mark.parametrize("count", [3, 5])
def test_joints_that_swing_fingers_around_the_palm_spread(tmp_path: Path, count: int) -> None:
    report = checked(tmp_path, ring(count, 0.4))
    assert report.facts["spreading_joints"] == [f"swing{i}" for i in range(count)]
    assert report.facts["palm_direction"] == pytest.approx([0, 0, 1], abs=0.1)


def test_an_index_finger_is_no_thumb_whatever_it_is_called(tmp_path: Path) -> None:
    names = ("IndexFinger", "MiddleFinger", "RingFinger")
    right = checked(tmp_path, human(names=names, called="Thumb"))
    assert (right.facts["thumb"], right.facts["confidence"]["thumb"]) == ("Thumb3", 1)
    swapped = checked(tmp_path, human(names=("Thumb", *names[1:]), called="IndexFinger"))
    assert (swapped.facts["thumb"], swapped.facts["side"]) == ("IndexFinger3", "right")
    assert ["another finger is called so" in text for text in doubts(swapped)] == [True]


@pytest.mark.parametrize("prefix", ["left_", "l_", "right_"])
def test_geometry_judges_a_side_in_names(tmp_path: Path, prefix: str) -> None:
    report = checked(tmp_path, human(side=-1, prefix=prefix))
    assert report.facts["side"] == "left"
    assert bool(doubts(report)) == (prefix == "right_")


def test_equal_fingers_all_around_have_no_side_and_a_doubtful_thumb(tmp_path: Path) -> None:
    report = checked(tmp_path, ring(4))
    assert report.facts["side"] == "none"
    assert report.facts["confidence"]["thumb"] < LOW
    assert any("low confidence" in note.text for note in report.notes)


@pytest.mark.parametrize("place", ["front", "side", "beside"])
def test_five_equal_fingers_one_of_which_faces_the_others(tmp_path: Path, place: str) -> None:
    def row(name: str) -> list[tuple[str, str, float, float, float]]:
        return [(f"{name}_a", "0 1 0", 0, 1.5, 0.04), (f"{name}_b", "0 1 0", 0, 1.5, 0.04)]

    at = {"front": '0.085 0 -0.02" rpy="0 0 3.1416', "side": '0.01 0.05 -0.02" rpy="-1.2 0 0',
          "beside": '0.02 0.05 -0.01" rpy="0 0.8 -1.5708'}[place]
    fingers = [finger(f"f{i}_", f"0 {0.036 - 0.024 * i} 0.05", row(f"f{i}")) for i in range(4)]
    report = checked(tmp_path, robot(block("palm", "0.03 0.1 0.1"), *fingers, finger("f4_", at, row("f4"))))
    assert report.facts["thumb"] == "f4_2"
    assert report.facts["palm_direction"] == pytest.approx([1, 0, 0], abs=0.3)
    assert set(report.facts["opening_signs"].values()) == {-1}


@pytest.mark.parametrize("text", [
    robot(block("palm", "0.04 0.12 0.06"), sliding("one", "0 1 0", 0.007, 0.045), sliding("other", "0 -1 0", 0.007, 0.045)),
    robot(block("palm", "0.04 0.12 0.06"), sliding("one", "0 1 0", 0.007, 0.045),
          sliding("other", "0 -1 0", 0.007, 0.045, '<mimic joint="one_slide"/>')),
    jaws(), jaws(block("cup", "0.02 0.02 0.03", "0 0 0.015"), fixed("cup", "0 0 0.03")),
    robot(block("palm", "0.04 0.12 0.06"), sliding("one", "0 1 0", -0.03, 0.045),
          block("still", "0.012 0.012 0.06", "0 0 0.03"), fixed("still", "0 -0.04 0.03")),
    robot(block("palm", "0.04 0.12 0.06"), block("still", "0.012 0.012 0.08", "0 0 0.04"), fixed("still", "0 -0.04 0.03"),
          finger("one", "0 0.04 0.03", [("a", "1 0 0", -0.5, 1.2, 0.05), ("b", "1 0 0", 0, 1.2, 0.04)]))],
    ids=["slide", "follow", "turn", "suction", "still and slide", "still and curl"])
def test_two_jaws_face_where_they_point(tmp_path: Path, text: str) -> None:
    report = checked(tmp_path, text)
    assert report.facts["palm_direction"] == pytest.approx([0, 0, 1], abs=0.3)
    assert (report.facts["thumb"], report.facts["side"]) == (None, "none")
    assert not doubts(report)


def test_a_rotor_within_the_palm_is_no_finger(tmp_path: Path) -> None:
    rotor = finger("rotor", "0.03 0 0.01", [("spin", "0 0 1", -1.5, 1.5, 0.02)])
    report = checked(tmp_path, human().replace("</robot>", f"{rotor}</robot>"))
    assert report.facts["fingertips"] == checked(tmp_path, human(), "plain.urdf").facts["fingertips"]
    assert (report.facts["thumb"], report.facts["side"]) == ("thumb3", "right")


def test_straight_is_where_a_finger_reaches_farthest_not_where_joints_are_zero(tmp_path: Path) -> None:
    """Middle joints are mounted bent by 50 degrees, and knuckles turn by 90 degrees both ways."""
    names = ("index", "middle", "ring", "little")
    text = human()
    for name in names:
        text = text.replace(f'<child link="{name}2"/><origin xyz="0 0 0.045"/>',
                            f'<child link="{name}2"/><origin xyz="0 0 0.045" rpy="0 0.873 0"/>')
    for end in ("mcp", "pip"):
        for name in names:
            lower = -QUARTER if end == "mcp" else -0.873
            before, after = text.split(f'<joint name="{name}_{end}"')
            text = f'{before}<joint name="{name}_{end}"' + after.replace('lower="-0.0"', f'lower="{lower}"', 1)
    report = checked(tmp_path, text)
    opened = report.facts["open_posture"]
    assert [opened[f"{name}_mcp"] for name in names] == pytest.approx([0.0] * 4, abs=0.15)
    assert [opened[f"{name}_pip"] for name in names] == pytest.approx([-0.873] * 4, abs=0.1)
    assert report.facts["palm_direction"] == pytest.approx([1, 0, 0], abs=0.3)


@pytest.mark.parametrize("off", [-0.012, 0.012])
def test_where_the_axis_of_a_spreading_joint_lies_bends_no_straight_finger(tmp_path: Path, off: float) -> None:
    """The frame of the joint that spreads a finger lies before or behind the hinges; the finger reaches no farther bent."""
    names, text = ("index", "middle", "ring", "little"), human(spread=(-0.35, 0.35))
    for name in names:
        place = text.split(f'<child link="{name}1"/><origin xyz="')[1].split('"')[0]
        text = text.replace(f'<child link="{name}1"/><origin xyz="{place}"/>',
                            f'<child link="{name}1"/><origin xyz="{off} {place.split(" ", 1)[1]}"/>')
        text = text.replace(f'<child link="{name}2"/><origin xyz="0 0 0.012"/>',
                            f'<child link="{name}2"/><origin xyz="{-off} 0 0.012"/>')
    for end in ("mcp", "pip"):
        for name in names:
            before, after = text.split(f'<joint name="{name}_{end}"')
            text = f'{before}<joint name="{name}_{end}"' + after.replace('upper="1.57"', 'upper="0.6"', 1)
    report = checked(tmp_path, text)
    assert report.facts["palm_direction"] == pytest.approx([1, 0, 0], abs=0.3)
    assert [report.facts["open_posture"][f"{name}_mcp"] for name in names] == pytest.approx([0.0] * 4, abs=1e-3)
    finder = HandBuilder(load_hand_description(tmp_path / "hand.urdf")[0]).finder
    straight = dict(zip(finder.tree.joint_names, finder.straight.tolist(), strict=True))
    assert [straight[f"{name}_{end}"] for name in names for end in ("mcp", "pip")] == pytest.approx([0.0] * 8, abs=0.1)


FLAT = robot(block("palm", "0.02 0.09 0.08"), *(finger(f"f{i}_", f"0 {0.03 * (i - 1)} 0.04", [
    (f"f{i}_a", "0 1 0", -1.5, 1.5, 0.045), (f"f{i}_b", "0 1 0", -1.5, 1.5, 0.04)]) for i in range(3)))


@pytest.mark.parametrize("way", [1, -1])
def test_a_flat_hand_is_doubtful_until_it_is_stated_how_it_closes(tmp_path: Path, way: int) -> None:
    plain = checked(tmp_path, FLAT)
    assert plain.facts["confidence"]["palm"] < LOW
    assert any("guess" in text for text in doubts(plain))
    joints = "".join(f'<joint name="f{i}_{j}" value="{way}"/>' for i in range(3) for j in "ab")
    written(tmp_path, f'<robot name="x"><group_state name="closed" group="g">{joints}</group_state></robot>', "hand.srdf")
    stated = checked(tmp_path, FLAT)
    assert stated.hand.sha256 != plain.hand.sha256
    assert set(stated.facts["opening_signs"].values()) == {-way}
    assert stated.facts["palm_direction"] == pytest.approx([way, 0, 0], abs=0.2)
    assert stated.facts["confidence"]["palm"] > LOW
    assert not doubts(stated)


@pytest.mark.parametrize("angle", [2.2, 2.36, 2.5])
def test_the_palm_of_a_flat_hand_faces_where_fingers_bend_whatever_a_thumb_does(tmp_path: Path, angle: float) -> None:
    """A plate out of the palm and the thumb beside it surround a ball, beside the row of fingers; all hinges bend both ways."""
    def hinges(name: str, first: str, axis: str) -> list[tuple[str, str, float, float, float]]:
        lengths = (0.028, 0.05, 0.06)
        return [(f"{name}_{i}", axis if i else first, -QUARTER, QUARTER, length) for i, length in enumerate(lengths)]

    row = [finger(f"f{i}_", f'0 {0.035 * i:.3f} {0.09 - 0.025 * i:.3f}" rpy="-0.3 0 0', hinges(f"f{i}", "1 0 0", "0 1 0"))
           for i in range(3)]
    thumb = finger("t_", '0.05 -0.06 -0.01" rpy="0 1.5708 0',
                   hinges("t", "0 0 1", f"{math.cos(angle):.4f} {math.sin(angle):.4f} 0"))
    plate = block("plate", "0.09 0.02 0.09") + fixed("plate", "0.05 -0.02 -0.03")
    report = checked(tmp_path, robot(block("palm", "0.026 0.11 0.09", "0 0.02 0"), *row, thumb, plate))
    assert report.facts["palm_direction"] == pytest.approx([0.95, 0, 0.3], abs=0.15)
    assert (report.facts["thumb"], report.facts["side"]) == ("t_3", "left")
    assert signs(report, "f0_1", "f1_1", "f2_1", "f0_2", "f1_2", "f2_2") == [-1] * 6
    assert any("guess" in text for text in doubts(report))


def test_a_keyframe_of_an_mjcf_may_state_how_it_closes(tmp_path: Path) -> None:
    one = ("<body name='{0}' pos='{1} 0 .01'><joint name='{0}' axis='0 1 0' range='-1.4 1.4'/>"
           "<geom type='box' size='.006 .006 .03' pos='0 0 .03'/></body>")
    text = ("<mujoco><compiler angle='radian' autolimits='true'/><worldbody><body name='palm'>"
            f"<geom type='box' size='.04 .04 .01'/>{one.format('a', -0.035)}{one.format('b', 0.035)}</body></worldbody>"
            "<keyframe><key name='closed' qpos='{}'/></keyframe></mujoco>")
    for values, ends in (("1 -1", [-1, 1]), ("-1 1", [1, -1])):
        assert dro.load_hand(written(tmp_path, text.format(values), "hand.xml")).opening_signs.tolist() == ends


def test_the_picture_tells_of_a_doubt(tmp_path: Path) -> None:
    from PIL import Image

    def words(report: HandReport) -> tuple[np.ndarray, np.ndarray]:
        """Where red words are, and all others, above and below what is drawn."""
        picture(report.hand, tmp_path / "hand.png")
        with Image.open(tmp_path / "hand.png") as sheet:
            pixels = np.array(sheet).astype(int)
        pixels[30:-30] = 255
        red = pixels[..., 0] > pixels[..., 1] + 20
        return np.argwhere(red), np.argwhere(~red & (pixels.sum(-1) < 600))

    red, black = words(checked(tmp_path, FLAT, f"{'a_hand_of_a_long_name' * 2}.urdf"))
    beside = black[(black[:, 0] >= red[:, 0].min()) & (black[:, 0] <= red[:, 0].max())]
    assert len(beside)
    assert beside[:, 1].max() + 10 < red[:, 1].min(), "words lie on one another"
    assert not len(words(checked(tmp_path, human(), "sure.urdf"))[0])


@pytest.mark.parametrize("name", ["allegro", "barrett", "gripper3", "leaphand", "shadowhand"])
def test_hands_that_are_read_right_are_not_doubted(name: str) -> None:
    report = check_hand(name)
    assert min(report.facts["confidence"].values()) > LOW
    assert torch.equal(report.hand.open_ends, loaded_hand(name).open_ends)


@pytest.mark.parametrize("way", [1, -1])
def test_fingers_of_one_joint_close_where_they_meet_the_thumb(tmp_path: Path, way: int) -> None:
    """Three fingers of a hinge each follow one joint, which bends them to one side only; the index bends both ways."""
    follows = [(name, 0, 1.4, '<mimic joint="middle"/>') for name in ("ring", "little")]
    hinge = [("index", -1.4, 1.4, ""), ("middle", 0, 1.4, ""), *follows]
    fingers = [finger(name, f"0 {0.033 - 0.022 * i} 0.05", [(name, f"0 {way} 0", lower, upper, 0.08)], mimic=mimic)
               for i, (name, lower, upper, mimic) in enumerate(hinge)]
    thumb = finger("thumb", f'{way * 0.02} 0.05 -0.02" rpy="-0.3 {way * 0.9} 0', [("thumb", f"0 {-way} 0", 0, 1.1, 0.06)])
    report = checked(tmp_path, robot(block("palm", "0.025 0.09 0.1"), *fingers, thumb))
    assert report.facts["palm_direction"] == pytest.approx([way, 0, 0], abs=0.4)
    assert signs(report, "index", "middle") == [-1, -1]
    assert report.facts["confidence"]["palm"] > LOW
    assert not doubts(report)


@pytest.mark.parametrize("side", [1, -1])
def test_a_whole_finger_that_one_joint_bends_back_shows_where_the_palm_is_when_straight(tmp_path: Path, side: int) -> None:
    """Each finger's joint, which drives both hinges, is straight at -0.6, its limit; at zero it is bent already."""
    text = human(side=side)
    for name in ("index", "middle", "ring", "little"):
        text = text.replace(f'<child link="{name}1"/><origin', f'<child link="{name}1"/><ORIGIN', 1)
        place = text.split('<ORIGIN xyz="')[1].split('"')[0]
        text = text.replace(f'<ORIGIN xyz="{place}"/>', f'<origin xyz="{place}" rpy="0 0.6 0"/>')
        text = text.replace(f'<child link="{name}2"/><origin xyz="0 0 0.045"/>',
                            f'<child link="{name}2"/><origin xyz="0 0 0.045" rpy="0 0.9 0"/>'
                            f'<mimic joint="{name}_mcp" multiplier="1.5"/>')
        before, after = text.split(f'<joint name="{name}_mcp"')
        text = f'{before}<joint name="{name}_mcp"' + after.replace('lower="-0.0"', 'lower="-0.6"', 1).replace(
            'upper="1.57"', 'upper="0.9"', 1).replace('lower="-0.0"', 'lower="-0.9"', 1)
    report = checked(tmp_path, text)
    assert report.facts["palm_direction"] == pytest.approx([1, 0, 0], abs=0.3)
    assert report.facts["side"] == SIDES[side]


@pytest.mark.parametrize(("farthest", "told"), [(1.2, False), (2.4, True)])
def test_a_thumb_that_opens_to_the_wrist_is_told(tmp_path: Path, farthest: float, told: bool) -> None:
    """It swings about an axis across the palm, from the fingers' direction over the palm's to the wrist's."""
    hinges = [("thumb_swing", "0 1 0", 0.4, farthest, 0.04), ("thumb_ip", "0 -1 0", 0.0, 1.0, 0.03)]
    text = human(hinges).replace('rpy="-0.9 0 0"', 'rpy="0 0 0"')
    report = checked(tmp_path, text)
    assert report.facts["open_posture"]["thumb_swing"] == pytest.approx(farthest, abs=0.01)
    assert [subject.subject for subject in report.notes if "towards the wrist" in subject.text] == ["thumb2"] * told


SLIDES = robot(block("palm", "0.12 0.06 0.04"), sliding("one", "1 0 0", 0.0, 0.04, at="0.01 0 0.02"),
               sliding("other", "-1 0 0", 0.0, 0.04, at="-0.01 0 0.02"))


@pytest.mark.parametrize(("text", "faced"), [
    (SLIDES, (0, 0, 1)), (jaws(), (0, 0, 1)), (ring(3), (0, 0, 1)), (human(), (1, 0, 0))],
    ids=["slides", "jaws", "ring", "human"])
def test_a_palm_without_shape_faces_where_its_fingers_say(tmp_path: Path, text: str, faced: tuple[float, float, float]) -> None:
    whole = check_hand(written(tmp_path, text, "whole.urdf"))
    bare = re.sub(r'<link name="palm">.*?</link>', '<link name="palm"/>', text, count=1)
    found = check_hand(written(tmp_path, bare, "bare.urdf"))
    assert np.dot(found.facts["palm_direction"], faced) > 0.9
    assert float((found.hand.grasp_centre_wrist - whole.hand.grasp_centre_wrist).norm()) < 0.04
    assert found.facts["opening_signs"] == whole.facts["opening_signs"]
    assert whole.facts["confidence"]["palm"] > LOW > found.facts["confidence"]["palm"]
    assert any(note.subject == "palm" and "its link has no shape" in note.text for note in found.notes)
