"""A hand within the file of a whole robot is the same hand alone. Oracle: MuJoCo's reading of the whole file."""

from __future__ import annotations

import math
import re
from contextlib import suppress
from io import BytesIO
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from dro_grasp.errors import HandError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.sources import hand_of, with_own_files, with_sources
from dro_grasp.hands.check import check_hand
from dro_grasp.hands.description.loader import load_description
from dro_grasp.hands.kinematics.tree import KinematicTree
from dro_grasp.hands.library import load_hand, locate_hand
from dro_grasp.hands.variants import vary_hand
from dro_grasp.objects.catalogue import load_object
from tests.helpers.claw_urdf import claw, joint, link, written
from tests.helpers.strange_hands import human
from tests.helpers.whole_robot import arm_with_claw, two_arms

LEFT = ("left_palm", "left_one", "left_other")


def in_palm(model: mujoco.MjModel, values: dict[str, float], links: tuple[str, ...]) -> np.ndarray:
    """Poses of links in that of the first one, by MuJoCo."""
    data = mujoco.MjData(model)
    for name, value in values.items():
        data.qpos[model.joint(name).qposadr[0]] = value
    mujoco.mj_kinematics(model, data)
    poses = np.tile(np.eye(4), (len(links), 1, 1))
    for T, name in zip(poses, links, strict=True):
        T[:3, :3], T[:3, 3] = data.body(name).xmat.reshape(3, 3), data.body(name).xpos
    return np.linalg.inv(poses[0]) @ poses


def posed(tree: KinematicTree, value: float, links: tuple[str, ...]) -> np.ndarray:
    """Poses of links by the tree, whose one free joint has this value."""
    assert tree.n_dof == 1
    return tree.double.forward(torch.tensor([value], dtype=torch.float64))[[tree.link_names.index(x) for x in links]].numpy()


def test_part_of_a_urdf_is_the_hand_within_the_robot(tmp_path: Path) -> None:
    path = written(tmp_path, two_arms(), "robot.urdf")
    part = load_description(path, "left_palm")
    assert part.tree.link_names == LEFT
    assert part.tree.joint_names == ("left_a",)
    assert part.name == "robot#left_palm"
    assert part.source == f"{path.resolve()}#left_palm"
    whole = mujoco.MjModel.from_xml_path(str(path))
    for value in (0.0, 0.7, 1.4):
        expected = in_palm(whole, {"left_a": value, "left_b": 0.9 * value, "left_elbow_joint": 0.3}, LEFT)
        np.testing.assert_allclose(posed(part.tree, value, LEFT), expected, atol=1e-6)
    assert len({load_description(path, side).sha256 for side in ("left_palm", "right_palm")}) == 2


def test_part_of_an_mjcf_keeps_units_classes_couplings_and_keys(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path, arm_with_claw(), "robot.xml")
    part = load_description(path, "palm")
    assert part.tree.link_names == ("palm", "one", "other")
    assert part.tree.joint_names == ("a",)
    assert float(part.tree.upper[0]) == pytest.approx(math.radians(80), abs=1e-6)
    assert part.model.dof_armature[0] == pytest.approx(0.001)
    assert part.model.nmesh == 0
    assert {name: part.open_posture[name] for name in part.tree.moving_names} == pytest.approx({"a": 5.0, "b": 4.5})
    whole = mujoco.MjModel.from_xml_path(str(path))
    for value in (0.2, 1.1):
        expected = in_palm(whole, {"a": value, "b": 0.9 * value, "wrist": 1.0}, part.tree.link_names)
        np.testing.assert_allclose(posed(part.tree, value, part.tree.link_names), expected, atol=1e-6)
    assert not any("ttach" in note.text for note in part.notes)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(("text", "name", "wrong"), [(two_arms(), "robot.urdf", "left_plam"),
                                                     (arm_with_claw(), "robot.xml", "plam")])
def test_link_that_is_not_there_is_refused_with_those_that_are_near(tmp_path: Path, text: str, name: str, wrong: str) -> None:
    path = written(tmp_path, text, name)
    with pytest.raises(HandError, match=rf"no link '{wrong}'.*perhaps .*palm"):
        load_description(path, wrong)


@pytest.mark.parametrize("arm", [False, True])
@pytest.mark.parametrize("more", [joint("lost", "left_one", "nowhere", "0 0 0"), link("left_one"),
                                  joint("loop", "left_one", "torso", "0 0 0")])
def test_faults_of_names_within_the_part_are_told_or_left_out(tmp_path: Path, more: str, arm: bool) -> None:
    path = written(tmp_path, two_arms(more), "robot.urdf")
    with suppress(HandError):  # any other error fails
        assert load_description(path, "left_palm", arm=arm).tree.n_dof


def test_faults_outside_the_part_do_not_matter(tmp_path: Path) -> None:
    broken = link("ear") + joint("ear_joint", "torso", "ear", "0 0 0", kind="planar")
    path = written(tmp_path, two_arms(broken), "robot.urdf")
    with pytest.raises(HandError, match="planar"):
        load_hand(path)
    assert load_hand(f"{path}#right_palm").wrist_link == "right_palm"


def test_robot_with_two_hands_is_refused_and_names_them(tmp_path: Path) -> None:
    path = written(tmp_path, two_arms(), "robot.urdf")
    with pytest.raises(HandError, match=r"whole robot.*robot\.urdf#left_palm, robot\.urdf#right_palm$"):
        load_hand(path)
    assert {load_hand(f"{path}#{palm}").name for palm in ("left_palm", "right_palm")} == {"robot#left_palm", "robot#right_palm"}


def test_arm_with_a_single_jaw_is_refused_and_the_jaw_is_a_hand(tmp_path: Path) -> None:
    links = link("upper") + link("lower") + link("jaw")
    joints = (joint("shoulder", "palm", "upper", "0 0 0.3") + joint("elbow", "upper", "lower", "0 0 0.3")
              + joint("grip", "lower", "jaw", "0.02 0 0.03"))
    path = written(tmp_path, claw(links=links, joints=joints), "arm.urdf")
    with pytest.raises(HandError, match=r"arm\.urdf: its fingertip 'jaw' is 0\.64 m .*an arm;.* arm\.urdf#lower$"):
        load_hand(path)
    assert load_hand(f"{path}#lower").tree.joint_names == ("grip",)


@pytest.mark.parametrize(("factor", "told"), [
    (4.0, r"is 0\.\d+ m .*; name the link at which the hand begins: hand\.urdf#palm for all of it, or for example"),
    (100.0, r"looks like centimetres: scale its origins, shapes and meshes by 0\.01; or these are arms")])
def test_a_hand_of_another_size_is_told_that_it_may_be_one(tmp_path: Path, factor: float, told: str) -> None:
    def larger(match: re.Match[str]) -> str:
        return match[1] + " ".join(str(float(x) * factor) for x in match[2].split()) + '"'

    mass = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    text = re.sub(r'((?:size|<origin xyz)=")([^"]*)"', larger, human().replace("</link>", mass))
    path = written(tmp_path, text, "hand.urdf")
    with pytest.raises(HandError, match=told):
        load_hand(path)
    if factor < 10:
        assert len(load_hand(f"{path}#palm").fingers) == 5


def test_arms_with_a_single_jaw_each_are_refused_before_their_palm_is_looked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    links = "".join(link(f"{side}_{part}") for side in "ab" for part in ("upper", "lower", "jaw"))
    joints = "".join(joint(f"{side}_shoulder", "palm", f"{side}_upper", f"{at} 0 0.3")
                     + joint(f"{side}_elbow", f"{side}_upper", f"{side}_lower", "0 0 0.3")
                     + joint(f"{side}_grip", f"{side}_lower", f"{side}_jaw", "0.02 0 0.03")
                     for side, at in (("a", 0.2), ("b", -0.2)))
    path = written(tmp_path, claw(links=links, joints=joints), "arms.urdf")
    monkeypatch.setattr("dro_grasp.hands.build.ClosingFinder", None)
    with pytest.raises(HandError, match=r"so these are arms or legs;.* arms\.urdf#a_lower or arms\.urdf#b_lower$"):
        load_hand(path)


def test_hand_on_an_arm_is_told_how_to_be_had_alone(tmp_path: Path) -> None:
    path = written(tmp_path, arm_with_claw(), "robot.xml")
    notes = [note.text for note in check_hand(path).notes if note.subject == "palm"]
    assert any("hangs on 2 joints" in text and "wrist is 'base'" in text and "robot.xml#palm" in text for text in notes)
    alone = check_hand(f"{path}#palm")
    assert not any("hangs on" in note.text for note in alone.notes)
    assert alone.facts["file"].endswith("robot.xml#palm")


def test_joints_that_move_the_whole_hand_are_left_out(tmp_path: Path) -> None:
    wide = '<limit lower="-20" upper="20" effort="1" velocity="1"/>'
    floats = "".join(f'<link name="root_{x}"/>' for x in "xyz")
    slides = joint("x", "root_x", "root_y", "0 0 0", more=wide, kind="prismatic") + joint(
        "y", "root_y", "root_z", "0 0 0", more=wide, kind="prismatic") + joint("turn", "root_z", "palm", "0 0 0")
    path = written(tmp_path, claw(floats + slides), "floating.urdf")
    hand = load_hand(path)
    assert hand.tree.joint_names == ("a", "b")
    assert hand.wrist_link == "root_x"
    assert torch.allclose(hand.palm_direction_wrist, load_hand(written(tmp_path, claw())).palm_direction_wrist, atol=1e-5)
    assert [n.subject for n in check_hand(path).notes if "moves the whole hand" in n.text] == ["x", "y", "turn"]
    with pytest.raises(HandError, match="millimetres"):
        load_description(path, arm=True)  # an arm's joints are not left out, so these limits count


def test_file_whose_name_has_the_mark_is_a_file(tmp_path: Path) -> None:
    path = written(tmp_path, claw(), "claw#1.urdf")
    assert locate_hand(path).link is None
    assert load_hand(path).name == "claw#1"


def test_variant_of_a_part_is_the_part(tmp_path: Path) -> None:
    path = written(tmp_path, two_arms(), "robot.urdf")
    grown = load_hand(written(tmp_path, vary_hand(f"{path}#left_palm", factor=1.5), "grown.urdf"))
    assert grown.tree.link_names == LEFT
    assert torch.allclose(grown.tree.origin[1:, :3, 3], 1.5 * load_hand(f"{path}#left_palm").tree.origin[1:, :3, 3], atol=1e-6)


def test_grasps_record_the_part_that_they_were_made_for(tmp_path: Path) -> None:
    given = f"{written(tmp_path, two_arms(), 'robot.urdf')}#left_palm"
    hand, obj = load_hand(given), load_object("sphere")
    grasps = GraspBatch.create(hand, obj, torch.eye(4)[None], torch.zeros(1, 1))
    for recorded in (with_sources(grasps, given, "sphere", 1.0), with_own_files(grasps, hand, obj)):
        found = hand_of(GraspBatch.load(BytesIO(recorded.to_bytes())), None)
        assert (found.name, found.sha256) == (hand.name, hand.sha256)


PLATE = '<link name="plate"><visual><geometry><box size="0.05 0.05 0.01"/></geometry></visual></link>'
FLAT = claw(PLATE + '<link name="mount"/><joint name="flange" type="fixed"><parent link="mount"/><child link="palm"/></joint>'
            '<joint name="skin" type="fixed"><parent link="palm"/><child link="plate"/></joint>')
FLAT_MJCF = ("<mujoco><worldbody><body name='mount'><geom size='.02'/><body name='palm'><geom type='box' size='.04 .04 .01'/>"
             "<body name='left' pos='-.03 0 0'><joint name='a' axis='0 1 0' range='0 80'/><geom size='.01'/></body>"
             "<body name='plate'><geom type='box' size='.02 .02 .01'/><site/></body></body></body></worldbody></mujoco>")


@pytest.mark.parametrize(("text", "name"), [(FLAT, "hand.urdf"), (FLAT_MJCF, "hand.xml")])
def test_a_link_beside_the_fingers_is_refused_and_the_one_that_carries_them_named(tmp_path: Path, text: str, name: str) -> None:
    path = written(tmp_path, text, name)
    with pytest.raises(HandError, match=rf"link 'plate' moves; the fingers hang on 'palm', which carries it: give {name}#palm"):
        load_hand(f"{path}#plate")
    with pytest.raises(HandError, match="nothing that hangs on link 'left' moves, so no hand begins there"):
        load_hand(f"{path}#left")
    assert load_hand(f"{path}#palm").tree.link_names[0] == "palm"
