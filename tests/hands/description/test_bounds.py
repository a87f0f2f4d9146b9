"""Descriptions that would exhaust time, memory or stack are refused before the work; absurd numbers with their owner's name."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
import torch

from dro_grasp.errors import HandError
from dro_grasp.hands.anatomy import LONGEST_FINGER, MAX_FINGERS
from dro_grasp.hands.description.compiling import NUMBERS
from dro_grasp.hands.description.loader import load_description
from dro_grasp.hands.library import load_hand
from tests.helpers.claw_urdf import LIMIT, claw, joint, link, written

FINGER = ('<body name="f{0}" pos="{0}e-3 0 0"><joint name="j{0}" axis="0 1 0" range="0 1"/>'
          '<geom type="capsule" size="0.007" fromto="0 0 0 0 0 0.05" mass="0.1"/></body>')
ATTACHED = '<body name="q"><attach model="m" body="{0}" prefix="x"/></body>'
HEAVY = '<inertial><origin xyz="0 0 1e30"/><mass value="1"/>' \
        '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'


def mjcf(more: str = "", before: str = "", after: str = "") -> str:
    fingers = FINGER.format(1) + FINGER.format(30)
    return (f'<mujoco><compiler angle="radian"/>{before}<worldbody><body name="palm"><geom type="box" size="0.05 0.05 0.01"/>'
            f"{fingers}{more}</body></worldbody>{after}</mujoco>")


def limits(upper: str, kind: str = "revolute") -> str:
    limit = f'<limit lower="0" upper="{upper}" effort="1" velocity="1"/>'
    return joint("a", "palm", "left", "0 0 0.01", more=limit, kind=kind) + joint("b", "palm", "right", "0.035 0 0.01")


@pytest.mark.parametrize(("text", "message"), [
    (claw(joints=limits("1e300")), r"the limits of joint 'a' is 0 1e\+300"),
    (claw(joints=limits("90")), r"the limits of joint 'a' is 0 90; .* this looks like degrees"),
    (claw(joints=limits("50", "prismatic")), r"the limits of joint 'a' are 0 50 m; expected at most 10 m"),
    (claw(joints=limits("1").replace("0 0 0.01", "1e30 0 0")), r"the origin of link 'left' is 1e\+30 0 0"),
    (claw(joints=limits("1").replace("0 0 0.01", "nan 0 0")), r"the origin of link 'left' is nan 0 0"),
    (claw(links=link("left").replace("<visual>", f"{HEAVY}<visual>") + link("right")), "centre of mass of link 'left' is"),
    (claw(joints=joint("a", "palm", "left", "0 0 0.01", more=LIMIT + '<mimic joint="b" multiplier="nan"/>')
          + joint("b", "palm", "right", "0.035 0 0.01")), "the coefficients of the coupling of joint 'a' is 0 nan"),
])
def test_absurd_numbers_of_a_urdf_are_refused_by_name(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(HandError, match=message):
        load_description(written(tmp_path, text))


@pytest.mark.parametrize(("text", "message"), [
    (mjcf().replace("range=", 'ref="1e30" range=', 1), r"the reference of joint 'j1' is 1e\+30"),
    (mjcf('<site name="eye" pos="0 -inf 0"/>', after='<equality><connect site1="eye" site2="eye"/></equality>'),
     "the place of site 'eye' is 0 -inf 0"),
    (mjcf(after='<equality><joint joint1="j1" joint2="j30" polycoef="0 1e30 0 0 0"/></equality>'), "coupling of joint 'j1'"),
    (mjcf(after='<equality><joint joint1="j1"/><joint joint1="j30"/></equality>'), "every joint follows another"),
    (mjcf('<replicate count="1000000" euler="0 0 1"><body><geom size="0.01"/></body></replicate>'), "1000 links"),
    (mjcf("<body>" * 3000 + "</body>" * 3000), "100 elements within each other"),
    (mjcf(before='<asset><hfield name="h" nrow="30000" ncol="30000" size="1 1 1 1"/></asset>'), "<hfield>, which is no part"),
    (mjcf(before='<asset><texture name="t" type="2d" builtin="flat" width="60000" height="60000"/></asset>'), "10000 pixels"),
    (mjcf(before='<asset><mesh name="m" builtin="supersphere" params="10000 1 1"/></asset>'), "divide it less"),
    (mjcf(ATTACHED.format("palm"), '<asset><model name="m" file="claw.xml"/></asset>'),
     "attaches 'claw.xml', which contains claw.xml itself"),
    (mjcf(before='<asset><mesh name="m" file="/dev/zero"/></asset>'), "files of meshes are missing"),
    (mjcf(before=f'<include file="{"a" * 5000}.xml"/>'), "which does not exist"),
])
def test_an_mjcf_that_grows_or_contains_itself_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(HandError, match=message):
        load_description(written(tmp_path, text, "claw.xml"))


def test_a_urdf_with_the_plugins_of_a_simulator_loads(tmp_path: Path) -> None:
    simulated = '<gazebo><plugin name="control" filename="libgazebo_ros_control.so"/></gazebo></robot>'
    text = claw().replace("</robot>", simulated)
    assert simulated in text
    assert load_hand(written(tmp_path, text)).tree.joint_names == ("a", "b")


def test_radians_that_are_read_as_degrees_are_warned_of(tmp_path: Path) -> None:
    """Angles of MJCF are degrees unless it says otherwise."""
    for text, warned in ((mjcf(), False), (mjcf().replace('angle="radian"', 'angle="degree"'), True)):
        notes = load_description(written(tmp_path, text, "claw.xml")).notes
        assert any("if the limits are radians" in note.text for note in notes) == warned


@pytest.mark.parametrize("turns", ["6.2832", "12.566"])
def test_a_joint_may_turn_twice(tmp_path: Path, turns: str) -> None:
    assert float(load_description(written(tmp_path, claw(joints=limits(turns)))).tree.upper[0]) == pytest.approx(float(turns))


def test_long_chains_and_many_joints_are_refused(tmp_path: Path) -> None:
    chain = claw(links="".join(link(f"l{i}") for i in range(150)), joints="".join(
        joint(f"j{i}", f"l{i - 1}" if i else "palm", f"l{i}", "0 0 0.01") for i in range(150)))
    star = claw(links="".join(link(f"l{i}") for i in range(150)), joints="".join(
        joint(f"j{i}", "palm", f"l{i}", "0 0 0.01") for i in range(150)))
    for text, message in ((chain, "100 links one below the other"), (star, "has 150 joints; expected at most 100")):
        with pytest.raises(HandError, match=message):
            load_description(written(tmp_path, text))


@pytest.mark.parametrize(("count", "branches", "message"), [
    (MAX_FINGERS + 1, True, "25 fingertips; expected at most 24"),
    (LONGEST_FINGER + 1, False, "has 13 joints; expected at most 12")])
def test_too_many_fingers_and_too_long_ones_are_refused(tmp_path: Path, count: int, branches: bool, message: str) -> None:
    text = claw(links="".join(link(f"l{i}") for i in range(count)), joints="".join(
        joint(f"j{i}", f"l{i - 1}" if i and not branches else "palm", f"l{i}", "0 0 0.01") for i in range(count)))
    with pytest.raises(HandError, match=message):
        load_hand(written(tmp_path, text))


def test_what_hands_have_is_within_the_bounds(tmp_path: Path) -> None:
    repeated = mjcf('<replicate count="3" euler="0 0 1"><body><geom size="0.01"/></body></replicate>')
    load_description(written(tmp_path, repeated, "a.xml"))
    (tmp_path / "part.xml").write_text("<mujoco><worldbody><body name='tip'><geom size='0.01'/></body></worldbody></mujoco>")
    attached = mjcf(ATTACHED.format("tip"), '<asset><model name="m" file="part.xml"/></asset>')
    description = load_description(written(tmp_path, attached, "b.xml"))
    assert any("tip" in name for name in description.tree.link_names)
    before = description.sha256
    (tmp_path / "part.xml").write_text("<mujoco><worldbody><body name='tip'><geom size='0.02'/></body></worldbody></mujoco>")
    assert load_description(tmp_path / "b.xml").sha256 != before


def test_a_hands_hash_is_the_same_wherever_its_folder_lies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for folder, name in (("models", "base.xml"), ("assets/shapes", "tip.obj"), ("z", "tip.xml")):
        (tmp_path / "m" / folder).mkdir(parents=True)
        (tmp_path / "m" / folder / name).write_text({
            "base.xml": "<mujoco><asset><mesh name='tip' file='tip.obj'/></asset></mujoco>",
            "tip.obj": "v 0 0 0\nv .02 0 0\nv 0 .02 0\nv 0 0 .02\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n",
            "tip.xml": "<mujoco><worldbody><body name='tip'><geom type='mesh' mesh='tip'/></body></worldbody></mujoco>"}[name])
    text = mjcf("", "<compiler meshdir='assets/shapes'/><include file='models/base.xml'/><include file='z/tip.xml'/>")
    written(tmp_path / "m", text, "claw.xml")
    (tmp_path / "link").symlink_to(tmp_path / "m")
    (tmp_path / "n").mkdir()
    monkeypatch.chdir(tmp_path / "n")
    found = {load_description(folder / "claw.xml").sha256
             for folder in (tmp_path / "m", tmp_path / "link", tmp_path / "n" / ".." / "m", Path("../m"))}
    assert len(found) == 1


@pytest.mark.parametrize("name", [row[1] for row in NUMBERS])
def test_every_checked_array_is_one_of_mujocos(tmp_path: Path, name: str) -> None:
    model = load_description(written(tmp_path, mjcf(), "claw.xml")).model
    assert re.fullmatch(r"\w+", name)
    assert hasattr(model, name)


RADIANS = ("<mujoco>{compiler}<worldbody><body name='palm' euler='0 0 1.2'><geom size='.02'/>"
           "<body name='finger' pos='0 0 .03' euler='.7 0 0'><joint name='bend' axis='1 0 0' limited='true' range='0 1.6'/>"
           "<geom size='.01'/></body></body></worldbody></mujoco>")


def test_radians_that_are_not_stated_are_found(tmp_path: Path) -> None:
    found = []
    for name, compiler in (("stated", "<compiler angle='radian'/>"), ("unsaid", "<compiler autolimits='true'/>")):
        path = tmp_path / f"{name}.xml"
        path.write_text(RADIANS.format(compiler=compiler))
        found.append(load_description(path))
    stated, unsaid = found
    torch.testing.assert_close(unsaid.tree.upper, stated.tree.upper)
    torch.testing.assert_close(unsaid.tree.origin, stated.tree.origin)
    assert [note.text for note in unsaid.notes if note.subject == "limits"] == [
        "no joint would turn by more than 1.6 degrees, MJCF's unit where none is stated; taken as radians: state "
        '<compiler angle="radian"/>']
    assert not stated.notes


def test_degrees_that_are_stated_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "hand.xml"
    path.write_text(RADIANS.format(compiler="<compiler angle='degree'/>"))
    description = load_description(path)
    assert description.tree.upper.tolist() == pytest.approx([math.radians(1.6)])
    assert ["no joint turns by more than" in note.text for note in description.notes] == [True]
