"""Names are hints: of a side that geometry does not show, of a thumb among fingers that oppose each other alike."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import dro_grasp as dro
from dro_grasp.hands.anatomy import find_thumb
from dro_grasp.hands.check import check_hand, hand_side
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.names import named_side, named_thumb, words_of
from tests.helpers.bracket_hand import bracket_urdf
from tests.helpers.claw_urdf import claw, joint, link, written


@pytest.mark.parametrize(("name", "words"), [
    ("leftPalm_2", ["left", "palm"]), ("IndexFinger1", ["index", "finger"]), ("LHThumb", ["lh", "thumb"]),
    ("l_index-tip", ["l", "index", "tip"]), ("link_3.0_tip", ["link", "tip"]), ("", [])])
def test_words_of_names(name: str, words: list[str]) -> None:
    assert words_of(name) == words


@pytest.mark.parametrize(("links", "others", "side"), [
    (["leftPalm", "index1"], [], "left"), (["palm_right", "f1_right"], [], "right"), (["l_palm", "l_f1", "l_f2"], [], "left"),
    (["palm_r", "f1_r"], [], "right"), (["palm", "f1"], ["hand_left"], "left"), (["left_jaw", "right_jaw"], [], None),
    (["palm", "l_1", "f2", "f3"], [], None), (["upright", "leftover"], [], None), (["palm"], [], None),
    (["l_palm", "l_right_pad"], [], "right")])
def test_sides_in_names(links: list[str], others: list[str], side: str | None) -> None:
    assert named_side(links, others) == side


def around(prefix: str = "", fingers: int = 4) -> str:
    """Fingers all around a palm, which show no side."""
    places = [("0.03 0.03", "-1 1 0"), ("-0.03 0.03", "-1 -1 0"), ("-0.03 -0.03", "1 -1 0"), ("0.03 -0.03", "1 1 0")][:fingers]
    links = "".join(link(f"{prefix}f{i}") for i in range(fingers))
    joints = "".join(joint(f"j{i}", "palm", f"{prefix}f{i}", f"{xy} 0.01", axis) for i, (xy, axis) in enumerate(places))
    return claw(links=links, joints=joints).replace('"palm"', f'"{prefix}palm"')


@pytest.mark.parametrize(("text", "name", "side"), [
    (around("leftHand"), "a.urdf", "left"), (around("r_"), "a.urdf", "right"), (around(), "hand_left.urdf", "left"),
    (around(), "a.urdf", "none"), (around("right_", 3), "a.urdf", "right"), (claw(), "left_claw.urdf", "none")])
def test_a_side_that_the_thumb_does_not_show_is_that_of_the_names(tmp_path: Path, text: str, name: str, side: str) -> None:
    assert hand_side(dro.load_hand(written(tmp_path, text, name))) == side


def test_the_thumb_judges_names_of_sides(tmp_path: Path) -> None:
    report = check_hand(written(tmp_path, bracket_urdf(1.0), "left_hand.urdf"))
    assert report.facts["side"] == "right"
    assert [note.text for note in report.notes if "by its names" in note.text] == [
        "is that of a left hand by its names and of a right hand by its thumb, which counts. Is the palm direction right?"]
    right = check_hand(written(tmp_path, bracket_urdf(1.0), "right_hand.urdf"))
    assert not [note for note in right.notes if "names" in note.text]


def test_a_thumb_in_names() -> None:
    assert named_thumb([["IndexFinger1", "IndexFinger2"], ["Thumb1", "Thumb2"], ["Middle"]]) == 1
    assert named_thumb([["finger"], ["thumb_a"], ["thumb_b"]]) is None
    assert named_thumb([["thing"], ["thumbtack"]]) is None


@pytest.mark.parametrize(("opposition", "named", "thumb"), [
    ([0.5, 0.3, -0.6, -0.5], 1, 1), ([0.5, 0.3, -0.6, -0.5], None, 0), ([0.9, -0.4, -0.5, -0.3], 1, 0),
    ([0.5, 0.4, 0.3], 1, None)])
def test_geometry_judges_the_name_of_a_thumb(opposition: list[float], named: int | None, thumb: int | None) -> None:
    assert find_thumb(torch.tensor(opposition), named) == thumb


def of(folder: Path, text: str) -> tuple[Hand, str | None]:
    hand = dro.load_hand(written(folder, text))
    return hand, None if hand.thumb is None else hand.tree.link_names[hand.tips[hand.thumb]]


@pytest.mark.parametrize("number", [0, 1, 2, 3])
def test_among_fingers_that_oppose_each_other_alike_the_one_called_thumb_is_it(tmp_path: Path, number: int) -> None:
    assert of(tmp_path, around().replace(f'"f{number}"', '"RightThumb3"'))[1] == "RightThumb3"


def test_a_finger_called_thumb_that_closes_with_the_others_is_none(tmp_path: Path) -> None:
    text = bracket_urdf().replace('"thumb"', '"opposing"').replace('"distal1"', '"Thumb"')
    assert of(tmp_path, text)[1] == "opposing"


def test_a_stored_hand_keeps_its_thumb(tmp_path: Path) -> None:
    hand, _ = of(tmp_path, around().replace('"f2"', '"thumb"'))
    stored = {k: list(v) if isinstance(v, tuple) else v for k, v in hand.to_tensors().items()}
    assert Hand.from_tensors(stored).thumb == hand.thumb == 2
