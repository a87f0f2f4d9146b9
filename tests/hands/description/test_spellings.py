"""Files whose words are not quite right: expressions of a template, lost meshes, limits that say nothing, a root `world`."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from dro_grasp.apps.library import _confine
from dro_grasp.errors import HandError, OptionError
from dro_grasp.hands.check import check_hand
from dro_grasp.hands.description.loader import load_description
from dro_grasp.hands.description.urdf import find_mesh
from dro_grasp.hands.library import load_hand
from tests.helpers.claw_urdf import LIMIT, claw, joint, link, meshed, written

SIZE = (0.012, 0.012, 0.06)
LEFT, RIGHT = joint("a", "palm", "left", "-0.035 0 0.01"), joint("b", "palm", "right", "0.035 0 0.01", "0 -1 0")


def tip(file: Path) -> Path:
    """A finger's box as a mesh file."""
    file.parent.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box(SIZE).export(file)
    return file


@pytest.mark.parametrize("text", [
    claw().replace("-0.035 0 0.01", "${-width/2} 0 0.01"), claw(joints=LEFT.replace("1.5", "${pi/2}") + RIGHT),
    claw().replace('size="0.08 0.08 0.02"', 'size="${2*r} 0.08 0.02"'), claw().replace("0 -1 0", "0 ${reflect} 0"),
    claw(joints=LEFT.replace("<axis", '<mimic joint="b" multiplier="${ratio}"/><axis') + RIGHT)])
def test_expressions_of_xacro_are_told(tmp_path: Path, text: str) -> None:
    with pytest.raises(HandError, match=r"\$\{.*\}.*, an expression of xacro; expand it first: xacro .*claw\.urdf"):
        load_description(written(tmp_path, text))


@pytest.mark.parametrize("space", [
    ' xmlns:xacro="http://www.ros.org/wiki/xacro"', ' xmlns:xacro="http://ros.org/wiki/xacro"',
    ' xmlns:xacro="http://www.ros.org/wiki/xacro/"', ' xmlns:xacro="http://wiki.ros.org/xacro"', ""])
def test_a_xacro_template_is_told_whatever_its_namespace(tmp_path: Path, space: str) -> None:
    text = f'<robot name="claw"{space}><xacro:include filename="fingers.xacro"/></robot>'
    with pytest.raises(HandError, match=r"is a xacro template.*; expand it first: xacro .*claw\.urdf\.xacro"):
        load_description(written(tmp_path, text, "claw.urdf.xacro"))


def test_expressions_in_names_and_in_what_nobody_reads_do_not_matter(tmp_path: Path) -> None:
    text = claw('<gazebo reference="left"><mu1 value="${mu}"/></gazebo>').replace('"palm"', '"${prefix}palm"')
    assert load_hand(written(tmp_path, text)).tree.joint_names == ("a", "b")


@pytest.mark.parametrize(("name", "at"), [
    ("Meshes/Tip.STL", "meshes/tip.stl"), ("meshes/tip.stl", "Meshes/tip.STL"),
    ("package://my_hand/meshes/TIP.stl", "meshes/tip.stl"),
    ("meshes/left%20tip.stl", "meshes/left tip.stl"), ("meshes%2Ftip.stl", "meshes/tip.stl"),
    ("MESHES/a%20b.stl", "meshes/A b.stl")])
def test_meshes_in_other_spellings_are_found_and_told(tmp_path: Path, name: str, at: str) -> None:
    mesh = tip(tmp_path / "my_hand" / at)
    description = load_description(written(tmp_path / "my_hand", meshed(name)))
    left = description.tree.link_names.index("left")
    assert {tuple(np.ptp(g.vertices, axis=0).round(5)) for g in description.geometry if g.link == left} == {SIZE}
    assert [note.text for note in description.notes if note.subject == name] == [f"was not found, and {mesh} is taken for it"]


def test_a_mesh_where_xacro_would_find_it_is_found(tmp_path: Path) -> None:
    mesh = tip(tmp_path / "my_hand" / "meshes" / "tip.stl")
    for name in ("$(find my_hand)/meshes/tip.stl", "file://$(find my_hand)/meshes/tip.stl"):
        assert find_mesh(name, tmp_path / "my_hand") == mesh


def test_the_very_name_comes_first(tmp_path: Path) -> None:
    tip(tmp_path / "TIP.stl")
    assert find_mesh("tip.stl", tmp_path) == tmp_path / "TIP.stl"
    tip(tmp_path / "tip.stl")
    assert find_mesh("tip.stl", tmp_path) == tmp_path / "tip.stl"
    assert not load_description(written(tmp_path, meshed("tip.stl"))).notes


def test_a_mesh_is_that_of_the_package_it_names(tmp_path: Path) -> None:
    """Not the one of the same name in the package of the file."""
    name, other = "meshes/tip.stl", tmp_path / "arm" / "meshes" / "tip.stl"
    tip(other)
    mesh, path = tip(tmp_path / "gripper" / name), tmp_path / "arm" / "urdf"
    path.mkdir()
    assert find_mesh(f"package://gripper/{name}", path) == mesh
    assert not load_description(written(path, meshed(f"package://gripper/{name}"))).notes
    mesh.unlink()
    assert find_mesh(f"package://gripper/{name}", path) == other
    (told,) = load_description(written(path, meshed(f"package://gripper/{name}"))).notes
    assert (told.level, told.subject) == ("warning", "gripper")
    assert f"meshes are taken from {tmp_path / 'arm'}" in told.text
    (tmp_path / "arm" / "package.xml").write_text("<package><name>gripper</name></package>")
    assert not load_description(path / "claw.urdf").notes, "a package in a folder of another name"


def test_a_mesh_that_is_not_in_the_folder_it_names_is_told(tmp_path: Path) -> None:
    mesh = tip(tmp_path / "tip.stl")
    (told,) = load_description(written(tmp_path, meshed("left/tip.stl"))).notes
    assert (told.subject, told.text) == ("left/tip.stl", f"was not found, and {mesh} is taken for it")


MJCF = ("<mujoco><compiler angle='radian' meshdir='meshes'/><asset><mesh name='tip' file='{}'/></asset><worldbody>"
        "<body name='palm'><geom type='box' size='.04 .04 .01'/><body name='left' pos='-.035 0 .01'>"
        "<joint name='a' axis='0 1 0' range='0 1.5'/>"
        "<geom type='mesh' mesh='tip' pos='0 0 .03'/></body><body name='right' pos='.035 0 .01'><joint name='b' axis='0 -1 0' "
        "range='0 1.5'/><geom type='mesh' mesh='tip' pos='0 0 .03'/></body></body></worldbody></mujoco>")


@pytest.mark.parametrize(("text", "name", "given"), [
    (meshed("meshes/tip.stl"), "hand.urdf", "meshes/tip.stl"), (MJCF.format("tip.stl"), "hand.xml", "tip.stl")])
def test_meshes_beside_the_target_of_a_link_are_found(tmp_path: Path, text: str, name: str, given: str) -> None:
    tip(tmp_path / "there" / "meshes" / "tip.stl")
    (here := tmp_path / "here").mkdir()
    target = written(tmp_path / "there", text, name)
    os.symlink(target, here / name)
    there, linked = load_hand(target), load_hand(here / name)
    torch.testing.assert_close(linked.link_points, there.link_points)
    assert linked.description is not None
    assert [note.subject for note in linked.description.notes] == [given]


def test_an_mjcf_that_is_a_link_includes_what_lies_beside_its_target(tmp_path: Path) -> None:
    (there := tmp_path / "there").mkdir()
    (here := tmp_path / "here").mkdir()
    written(there, "<mujoco><default><geom friction='1'/></default></mujoco>", "defaults.xml")
    tip(there / "meshes" / "tip.stl")
    text = MJCF.format("tip.stl").replace("<asset>", "<include file='defaults.xml'/><asset>")
    os.symlink(written(there, text, "hand.xml"), here / "hand.xml")
    assert load_hand(here / "hand.xml").tree.joint_names == ("a", "b")


def test_meshes_of_an_mjcf_in_another_case_are_found_and_told(tmp_path: Path) -> None:
    mesh = tip(tmp_path / "meshes" / "tip.stl")
    description = load_description(written(tmp_path, MJCF.format("Tip.STL"), "hand.xml"))
    assert [(note.subject, note.text) for note in description.notes] == [
        ("Tip.STL", f"was not found, and {mesh} is taken for it")]


@pytest.mark.parametrize("name", ["%2e%2e/secret.stl", "x/%2e%2e/%2e%2e/secret.stl", "%2e%2e/SECRET.stl"])
def test_an_upload_reaches_no_file_outside_by_another_spelling(tmp_path: Path, name: str) -> None:
    tip(tmp_path / "secret.stl")
    (folder := tmp_path / "upload" / "x").mkdir(parents=True)
    written(folder.parent, meshed(name))
    with pytest.raises(OptionError, match="was not uploaded with it"):
        _confine(folder.parent)


def test_limits_that_leave_nothing_to_move_are_told(tmp_path: Path) -> None:
    text = claw().replace('upper="1.5"', 'upper="0"')
    with pytest.raises(HandError, match=r"has no moving joint \(2 fixed\).*Both limits of 2 joints are zero \(a, b\)"):
        load_description(written(tmp_path, text))
    fixed = claw().replace("revolute", "fixed").replace(LIMIT, "")
    with pytest.raises(HandError, match=r"prismatic joint$"):
        load_description(written(tmp_path, fixed))


def test_limits_of_a_continuous_joint_are_told_and_not_used(tmp_path: Path) -> None:
    text = claw(joints=joint("a", "palm", "left", "-0.035 0 0.01", kind="continuous") + RIGHT)
    report = check_hand(written(tmp_path, text))
    told = [note.text for note in report.notes if note.subject == "a" and note.level == "warning"]
    assert len(told) == 1
    assert told[0].startswith("states limits of 0 to 1.5, but is continuous")
    assert report.hand.description is not None
    assert float(report.hand.description.tree.upper[0]) == pytest.approx(np.pi)


def test_a_continuous_joint_without_limits_states_none(tmp_path: Path) -> None:
    free = joint("a", "palm", "left", "-0.035 0 0.01", kind="continuous", more='<limit effort="1" velocity="1"/>')
    told = [note.text for note in load_description(written(tmp_path, claw(joints=free + RIGHT))).notes]
    assert [text.split(";")[0] for text in told] == ["states no limits"]


@pytest.mark.parametrize("kind", ["fixed", "floating"])
def test_a_root_called_world_tells_how_to_have_a_frame_that_robots_have(tmp_path: Path, kind: str) -> None:
    more = link("world", kinds=()) + joint("stands", "world", "palm", "0 0 0.5", kind=kind, more="")
    path = written(tmp_path, claw(more))
    told = [note.text for note in check_hand(path).notes if note.subject == "world"]
    assert [text.endswith("for poses of link 'palm' give claw.urdf#palm") for text in told] == [True]
    whole, part, alone = load_hand(path), load_hand(f"{path}#palm"), load_hand(written(tmp_path, claw(), "alone.urdf"))
    assert (whole.wrist_link, part.wrist_link) == ("world_link", "palm")
    assert torch.equal(part.link_points, alone.link_points)
    torch.testing.assert_close(whole.grasp_centre_wrist, part.grasp_centre_wrist + torch.tensor([0, 0, 0.5]), atol=1e-5, rtol=0)


@pytest.mark.parametrize(("right", "wrong", "told"), [
    ('size="0.012 0.012 0.06"', 'size="1 1"', "Element 'box' of link 'left'"),
    ('xyz="0.035 0 0.01"', 'xyz="0 0"', "Element 'origin' of joint 'b'")])
def test_what_mujoco_refuses_is_told_by_its_link(tmp_path: Path, right: str, wrong: str, told: str) -> None:
    """A line of the text that it is given is none of the file, which begins with a comment here."""
    path = written(tmp_path, "<!-- a\nlicence\n-->\n" + claw().replace(right, wrong, 1))
    with pytest.raises(HandError) as found:
        load_description(path)
    assert told in str(found.value)
    assert "line" not in str(found.value).replace(str(path), "")


def test_a_root_called_world_that_carries_the_fingers_names_no_other(tmp_path: Path) -> None:
    (told,) = load_description(written(tmp_path, claw().replace('"palm"', '"world"'))).notes
    assert told.text == "is MuJoCo's name for the ground; this link is called 'world_link' here and in exported files"


RANGES = ("<mujoco><compiler {compiler}/><worldbody><body name='palm'><geom type='box' size='.04 .04 .01'/>"
          "<body name='left' pos='-.035 0 .01'><joint name='a' axis='0 1 0' {a}/><geom type='box' size='.006 .006 .03' "
          "pos='0 0 .03'/></body><body name='right' pos='.035 0 .01'><joint name='b' axis='0 -1 0' {b}/><geom type='box' "
          "size='.006 .006 .03' pos='0 0 .03'/></body></body></worldbody></mujoco>")
RADIAN = "angle='radian'"


@pytest.mark.parametrize(("compiler", "limits", "value"), [
    (RADIAN, "limited='true' range='0 0'", 0.0), (RADIAN, "limited='true'", 0.0),
    (RADIAN, "limited='true' range='.4 .4' ref='.1'", 0.4),
    ("angle='degree'", "limited='true' range='30 30' ref='10'", np.radians(30))])
def test_a_joint_of_an_mjcf_that_is_limited_to_one_value_is_held(
    tmp_path: Path, compiler: str, limits: str, value: float
) -> None:
    other = "range='0 1.5'" if compiler == RADIAN else "range='0 86'"
    description = load_description(written(tmp_path, RANGES.format(compiler=compiler, a=limits, b=other), "hand.xml"))
    assert description.tree.joint_names == ("b",)
    assert float(description.tree.offset[0]) == pytest.approx(value, abs=1e-6)
    assert ["is held there" in note.text for note in description.notes if note.subject == "a"] == [True]


def test_an_mjcf_all_of_whose_joints_are_limited_to_one_value_is_refused(tmp_path: Path) -> None:
    limits = "limited='true' range='0 0'"
    with pytest.raises(HandError, match=r"no moving joint: both limits of 2 joints are equal \(a, b\); state their limits"):
        load_description(written(tmp_path, RANGES.format(compiler=RADIAN, a=limits, b=limits), "hand.xml"))


@pytest.mark.parametrize(("limits", "told"), [
    ("range='0 1' limited='false'", "states no limits that count (0 to 1, but limited is 'false'); taken as +-3.14"),
    ("range='1 0'", "states no limits that count (1 to 0); taken as +-3.14"), ("", "states no limits; taken as +-3.14")])
def test_limits_of_an_mjcf_that_do_not_count_are_told(tmp_path: Path, limits: str, told: str) -> None:
    text = RANGES.format(compiler=RADIAN, a=limits, b="range='0 1.5'")
    assert [note.text for note in load_description(written(tmp_path, text, "hand.xml")).notes] == [told]


@pytest.mark.parametrize("kind", ["text.stl", "tip.dae", "tip.ply", "normals.obj"])
def test_meshes_of_an_mjcf_that_mujoco_refuses_are_read(tmp_path: Path, kind: str) -> None:
    box, file = trimesh.creation.box(SIZE), tmp_path / "meshes" / kind
    file.parent.mkdir()
    if kind == "text.stl":
        file.write_text(trimesh.exchange.stl.export_stl_ascii(box))
    elif kind == "normals.obj":  # of some corners alone
        text = trimesh.exchange.obj.export_obj(box, include_normals=False)
        file.write_text(re.sub(r"\nf (\d+) (\d+) (\d+)", r"\nvn 0 0 1\nf \1//1 \2//1 \3//1", text, count=1))
    else:
        box.export(file)
    path = written(tmp_path, MJCF.format(kind), "hand.xml")
    for part in (path, f"{path}#palm"):
        description = load_hand(part).description
        assert description is not None
        left = description.tree.link_names.index("left")
        sizes = [np.ptp(g.vertices, axis=0).round(5).tolist() for g in description.geometry if g.link == left]
        assert sizes == [list(SIZE)]


def test_a_urdf_may_have_normals_on_some_corners(tmp_path: Path) -> None:
    text = trimesh.exchange.obj.export_obj(trimesh.creation.box(SIZE), include_normals=False)
    written(tmp_path, re.sub(r"\nf (\d+) (\d+) (\d+)", r"\nvn 0 0 1\nf \1//1 \2//1 \3//1", text, count=1), "tip.obj")
    assert len(load_hand(written(tmp_path, meshed("tip.obj"))).fingers) == 2


def test_looks_cost_no_hand(tmp_path: Path) -> None:
    """A texture that is not there, and a colour of three numbers."""
    tip(tmp_path / "meshes" / "tip.stl")
    looks = "<asset><texture name='t' type='2d' file='lost.png'/><material name='m' texture='t'/>"
    mjcf = MJCF.format("tip.stl").replace("<asset>", looks).replace("<geom type='mesh'", "<geom material='m' type='mesh'")
    plain = load_hand(written(tmp_path, MJCF.format("tip.stl"), "plain.xml"))
    torch.testing.assert_close(load_hand(written(tmp_path, mjcf, "hand.xml")).link_points, plain.link_points)
    colour = '<material name="white"><color rgba="1 1 1"/></material>'
    urdf = claw(colour).replace("<visual>", f"<visual>{colour}")
    torch.testing.assert_close(
        load_hand(written(tmp_path, urdf)).link_points, load_hand(written(tmp_path, claw(), "plain.urdf")).link_points)
