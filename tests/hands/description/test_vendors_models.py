"""What models of vendors bring: frames around hands, followers without limits, keys of controls, attached files, text STL."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import trimesh

import dro_grasp as dro
from dro_grasp.hands.description.loader import load_description
from dro_grasp.simulation.scene import attach

FINGER = """<body name="{name}" pos="{x} 0 0.01"><joint name="{name}_j" axis="0 {side} 0" {limits}/>
  <geom type="box" size="0.006 0.006 0.03" pos="0 0 0.03"/></body>"""
JAW = """<body name="{name}" pos="{x} 0 0.04"><joint name="{name}_j" type="slide" axis="{side} 0 0" {limits}/>
  <geom type="box" size="0.006 0.01 0.03"/></body>"""
PALM = '<body name="palm"><geom type="box" size="0.05 0.04 0.01"/>{fingers}</body>'


def fingers(form: str, a: str, b: str) -> str:
    return form.format(name="a", x=-0.035, side=1, limits=a) + form.format(name="b", x=0.035, side=-1, limits=b)


def written(folder: Path, world: str, more: str = "", angle: str = "radian", name: str = "hand.xml") -> Path:
    path = folder / name
    path.write_text(f'<mujoco><compiler angle="{angle}"/>{more}<worldbody>{world}</worldbody></mujoco>')
    return path


def test_a_frame_around_a_hand_does_not_move_it(tmp_path: Path) -> None:
    hand = PALM.format(fingers=fingers(FINGER, 'range="0 1.2"', 'range="0 1.2"'))
    found = load_description(written(tmp_path, f'<frame pos="0 0 1" euler="0 0 1">{hand}</frame>'))
    scene = mujoco.MjSpec()
    attach(scene, found.spec(), scene.worldbody.add_frame(), "hand/")
    T = found.tree.forward(torch.zeros(2))[found.tree.link_names.index("a")]
    for model, prefix in ((found.model, ""), (scene.compile(), "hand/")):
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(data.body(f"{prefix}palm").xpos, 0, atol=1e-9)
        np.testing.assert_allclose(data.body(f"{prefix}a").xpos, T[:3, 3], atol=1e-6)


@pytest.mark.parametrize(("form", "leader", "ratio", "end"), [
    (JAW, 'range="0 0.08"', 1, 0.08), (FINGER, 'range="0 1.2"', 4, 1.2)])
def test_a_follower_without_limits_takes_none_of_its_leader_s(
    tmp_path: Path, form: str, leader: str, ratio: int, end: float
) -> None:
    tie = f'<equality><joint joint1="b_j" joint2="a_j" polycoef="0 {ratio} 0 0 0"/></equality>'
    found = load_description(written(tmp_path, PALM.format(fingers=fingers(form, leader, "")), tie))
    assert found.tree.upper.tolist() == pytest.approx([end])
    assert not [note for note in found.notes if note.subject == "b_j"]


def test_a_key_of_controls_alone_states_no_posture(tmp_path: Path) -> None:
    more = ('<actuator><position joint="a_j" ctrlrange="0 0.08"/></actuator><keyframe><key name="open" ctrl="0.08"/></keyframe>'
            '<equality><joint joint1="b_j" joint2="a_j"/></equality>')
    found = load_description(written(tmp_path, PALM.format(fingers=fingers(JAW, 'range="0 0.08"', 'range="0 0.08"')), more))
    assert found.open_posture == {}


def test_limits_that_are_assumed_have_the_unit_of_their_own_file(tmp_path: Path) -> None:
    written(tmp_path, PALM.format(fingers=fingers(FINGER, "", "")), angle="degree", name="child.xml")
    path = tmp_path / "parent.xml"
    path.write_text('<mujoco><compiler angle="radian"/><asset><model name="child" file="child.xml"/></asset><worldbody>'
                    '<body name="base"><geom size="0.01"/><attach model="child" body="palm" prefix="c_"/></body></worldbody>'
                    '</mujoco>')
    assert load_description(path).tree.upper.tolist() == pytest.approx([math.pi] * 2)


URDF = """<robot name="two"><link name="palm"><collision><geometry><box size="0.08 0.06 0.02"/></geometry></collision></link>
{links}</robot>"""
LINK = """<link name="{name}"><collision><geometry>{shape}</geometry></collision></link>
<joint name="{name}_j" type="revolute"><parent link="palm"/><child link="{name}"/><origin xyz="{x} 0 0.04"/>
<axis xyz="0 {side} 0"/><limit lower="0" upper="1.2" effort="1" velocity="1"/></joint>"""


def two(folder: Path, shape: str) -> Path:
    links = "".join(LINK.format(name=name, shape=shape, x=x, side=side) for name, x, side in (("a", -0.03, 1), ("b", 0.03, -1)))
    path = folder / "two.urdf"
    path.write_text(URDF.format(links=links))
    return path


def test_a_misspelt_joint_of_a_posture_is_told(tmp_path: Path) -> None:
    path = two(tmp_path, '<box size="0.01 0.01 0.05"/>')
    (tmp_path / "two.srdf").write_text('<robot name="two"><group_state name="open" group="hand"><joint name="a_j" value="0.1"/>'
                                       '<joint name="typo" value="0.4"/></group_state></robot>')
    told = [note for note in load_description(path).notes if "posture" in note.text]
    assert [note.subject for note in told] == ["typo"]


def test_a_mesh_as_text_stl_is_read(tmp_path: Path) -> None:
    box = trimesh.creation.box((0.01, 0.01, 0.05))
    (tmp_path / "tip.stl").write_text(box.export(file_type="stl_ascii"))
    hand = dro.load_hand(two(tmp_path, '<mesh filename="tip.stl"/>'))
    assert len(hand.fingers) == 2
