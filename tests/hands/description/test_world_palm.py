"""MJCF whose palm is geoms of the world. Oracle: the same hand with a body for its palm."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from dro_grasp.hands.check import check_hand
from dro_grasp.hands.description.loader import load_description
from dro_grasp.hands.library import load_hand
from tests.helpers.claw_urdf import written

PALM = '<geom name="face" type="box" size=".04 .04 .01"/>'
FINGER = """<body name="{n}" pos="{x} {y} .01" euler="0 0 {turn}"><joint name="{n}_a" axis="0 1 0" range="0 80"/>
  <geom type="box" size=".006 .006 .02" pos="0 0 .02"/><body name="{n}_tip" pos="0 0 .04"><joint name="{n}_b" axis="0 1 0"
  range="0 80"/><geom type="box" size=".006 .006 .02" pos="0 0 .02"/></body></body>"""
TURNS = (0, 120, 240)
FINGERS = "".join(FINGER.format(n=f"f{i}", x=-0.035 * np.cos(np.radians(t)), y=-0.035 * np.sin(np.radians(t)), turn=t)
                  for i, t in enumerate(TURNS))
TIE = '<equality><joint joint1="f1_b" joint2="f0_b" polycoef="0 .5 0 0 0"/></equality>'
SCENE = ('<geom type="plane" size="1 1 .1"/><geom type="box" size=".5 .5 .02" pos="0 0 -.3"/><body name="ball" pos="0 0 .2">'
         '<freejoint/><geom size=".03"/></body><body name="shelf" pos="1 0 0"><geom size=".1"/></body>')


def mjcf(world: str, after: str = TIE) -> str:
    return f'<mujoco><compiler angle="degree"/><worldbody>{world}</worldbody>{after}</mujoco>'


def same(folder: Path, world: str, after: str = TIE) -> None:
    """A hand is the one whose palm is a body."""
    plain = load_hand(written(folder, mjcf(f'<body name="palm">{PALM}{FINGERS}</body>'), "plain.xml"))
    hand = load_hand(written(folder, mjcf(world, after), "hand.xml"))
    assert hand.tree.joint_names == plain.tree.joint_names
    assert hand.tree.link_names[hand.palm] == "palm"
    for mine, theirs in ((hand.palm_direction_wrist, plain.palm_direction_wrist), (hand.open_ends, plain.open_ends),
                         (hand.closed_ends, plain.closed_ends), (hand.grasp_centre_wrist, plain.grasp_centre_wrist)):
        torch.testing.assert_close(mine, theirs, atol=1e-4, rtol=0)
    assert len(hand.fingers) == 3


@pytest.mark.parametrize("world", [
    PALM + FINGERS, FINGERS + PALM, PALM + FINGERS + SCENE, SCENE + PALM + FINGERS,
    f"<frame name='at'>{PALM}{FINGERS}</frame>"])
def test_fingers_on_geoms_of_the_world_are_one_hand(tmp_path: Path, world: str) -> None:
    same(tmp_path, world)


def test_fingers_beside_a_palm_that_stands_still_are_one_hand(tmp_path: Path) -> None:
    hand = load_hand(written(tmp_path, mjcf(f'<body name="palm">{PALM}</body>{FINGERS}{SCENE}'), "hand.xml"))
    assert len(hand.fingers) == 3
    assert float(hand.palm_direction_wrist[2]) > 0.95
    assert "palm" in hand.tree.link_names


def test_fingers_of_a_world_without_palm_are_one_hand(tmp_path: Path) -> None:
    assert len(load_hand(written(tmp_path, mjcf(FINGERS), "hand.xml")).fingers) == 3


def test_poses_are_those_of_mujoco(tmp_path: Path) -> None:
    path = written(tmp_path, mjcf(PALM + FINGERS + SCENE), "hand.xml")
    tree, model = load_description(path).tree, mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    q = torch.linspace(0.1, 0.9, tree.n_dof)
    values = tree.coupling @ q + tree.offset
    for name, value in zip(tree.moving_names, values.tolist(), strict=True):
        data.qpos[model.joint(name).qposadr[0]] = value
    mujoco.mj_kinematics(model, data)
    for link in ("f0_tip", "f1_tip", "f2_tip"):
        pose = tree.forward(q)[tree.link_names.index(link)].numpy()
        np.testing.assert_allclose(pose[:3, 3], data.body(link).xpos, atol=1e-6)


def test_an_actuator_a_key_and_meshes_survive(tmp_path: Path) -> None:
    corners = "".join(f"v {x}\n" for x in ("0 0 0", ".01 0 0", "0 .01 0", "0 0 .01"))
    tetrahedron = corners + "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "meshes").mkdir()
    written(tmp_path / "meshes", tetrahedron, "nail.obj")
    after = (TIE + '<actuator><position joint="f0_a" forcerange="-2 2"/></actuator><keyframe><key name="open" '
             'qpos=".1 0 .1 0 .1 0"/></keyframe><asset><mesh name="nail" file="nail.obj"/></asset>')
    world = PALM + '<geom type="mesh" mesh="nail" pos="0 0 -.01"/>' + FINGERS
    text = mjcf(world, after).replace('angle="degree"', 'angle="degree" meshdir="meshes"')
    description = load_description(written(tmp_path, text, "hand.xml"))
    assert description.open_posture["f0_a"] == pytest.approx(0.1)
    assert description.efforts[description.tree.joint_names.index("f0_a")] == pytest.approx(2.0)
    assert description.model.nmesh == 1
    assert len(load_hand(tmp_path / "hand.xml").fingers) == 3


def test_it_is_told_and_scenery_is_left_out(tmp_path: Path) -> None:
    report = check_hand(written(tmp_path, mjcf(PALM + FINGERS + SCENE), "hand.xml"))
    told = {note.subject: note.text for note in report.notes}
    assert told["palm"] == "is a link for the shapes of the world, on which 3 fingers hang"
    assert "left out" in told["ball"]
    assert "left out" in told["shelf"]
    assert max(report.facts["size_m"]) < 0.25


@pytest.mark.parametrize("beside", [
    '<body name="drawer" pos=".2 0 0"><joint name="pull" type="slide" axis="1 0 0" range="0 .1"/><geom size=".03"/></body>',
    '<geom type="box" size=".05 .05 .05" pos=".1 0 0"/>'])
def test_a_hand_that_is_a_body_stays_alone_in_its_world(tmp_path: Path, beside: str) -> None:
    hand = load_hand(written(tmp_path, mjcf(f'<body name="palm">{PALM}{FINGERS}</body>{beside}'), "hand.xml"))
    assert hand.tree.link_names[0] == "palm"
    assert not any("drawer" in name for name in hand.tree.link_names)
    assert len(hand.fingers) == 3


def test_arms_that_stand_apart_are_no_fingers(tmp_path: Path) -> None:
    near, far = (FINGER.format(n=name, x=x, y=0, turn=0) for name, x in (("f", 0), ("g", 0.6)))
    assert load_description(written(tmp_path, mjcf(near + far, ""), "two.xml")).tree.link_names == ("f", "f_tip")
