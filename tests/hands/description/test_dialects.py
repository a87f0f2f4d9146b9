"""MJCF files in words that this version of MuJoCo does not know. Oracle: the same file without them."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from dro_grasp.errors import HandError
from dro_grasp.hands.check import check_hand
from dro_grasp.hands.library import load_hand

CLAW = ("<mujoco><compiler angle='radian'/><option/><visual/><default><geom/></default><asset/><worldbody>"
        "<body name='palm'><geom type='box' size='.04 .04 .01'/>"
        "<body name='left' pos='-.035 0 .01'><joint name='a' axis='0 1 0' range='0 1.5'/>"
        "<geom type='box' size='.006 .006 .03' pos='0 0 .03'/></body>"
        "<body name='right' pos='.035 0 .01'><joint name='b' axis='0 -1 0' range='0 1.5'/>"
        "<geom type='box' size='.006 .006 .03' pos='0 0 .03'/></body></body></worldbody>"
        "<actuator><position joint='a' kp='1'/></actuator><sensor/></mujoco>")


def written(folder: Path, *changes: tuple[str, str]) -> Path:
    """The claw, with changes."""
    text = CLAW
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "hand.xml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(("old", "new", "told"), [
    ("<option/>", "<option collision='all'/>", 'collision="all"'),
    ("<option/>", "<option apirate='100' mpr_tolerance='1e-6'/>", 'apirate="100"'),
    ("<option/>", "<option><flag passive='disable'/></option>", 'passive="disable"'),
    ("<compiler ", "<compiler convexhull='true' ", 'convexhull="true"'),
    ("<geom/>", "<geom collision='predefined'/>", 'collision="predefined"'),
    ("kp='1'", "kp='1' stiff='2'", 'stiff="2"'),
    ("<visual/>", "<visual><fog colour='1'/></visual>", "<fog> in <visual>"),
    ("<sensor/>", "<sensor><taste joint='a'/></sensor>", "<taste> in <sensor>")])
def test_words_that_say_nothing_about_a_hand_are_left_out_and_told(tmp_path: Path, old: str, new: str, told: str) -> None:
    plain = load_hand(written(tmp_path))
    report = check_hand(written(tmp_path, (old, new)))
    torch.testing.assert_close(report.hand.link_points, plain.link_points)
    assert report.hand.tree.joint_names == ("a", "b")
    assert any(f"has {told}, which MuJoCo" in note.text and note.level == "warning" for note in report.notes)


def test_several_words_and_those_of_included_files_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "settings.xml").write_text("<mujoco><option collision='all' apirate='9'/><compiler angle='radian'/></mujoco>")
    path = written(tmp_path, ("<option/>", "<include file='settings.xml'/><option jacobian='dense' impedance='1'/>"))
    report = check_hand(path)
    told = [note.text for note in report.notes if "does not know" in note.text]
    assert [any(word in text for text in told) for word in ('collision="all"', 'apirate="9"', 'impedance="1"')] == [True] * 3
    assert float(report.hand.tree.upper[0]) == pytest.approx(1.5)


@pytest.mark.parametrize(("old", "new", "named"), [
    ("range='0 1.5'", "rangee='0 1.5'", "rangee"), ("pos='-.035 0 .01'", "position='-.035 0 .01'", "position"),
    ("<asset/>", "<assets/>", "assets"), ("<geom/>", "<geometry/>", "geometry")])
def test_words_that_may_say_what_the_hand_is_are_refused(tmp_path: Path, old: str, new: str, named: str) -> None:
    with pytest.raises(HandError, match=f"unrecognized.*{named}"):
        load_hand(written(tmp_path, (old, new)))
