"""Closed loops as couplings, against MuJoCo's simulation of the ties and against geometry."""

from __future__ import annotations

import math
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from dro_grasp.errors import HandError
from dro_grasp.hands.description.loader import Description, load_description
from tests.helpers.linkage_gripper import PIN, linkage_xml, write_linkage

BOX = "<geom type='box' size='.02 .02 .01' mass='.1'/>"
BALL = "<geom size='.01' mass='.1'/>"
TWO_JOINTS = (
    f"<body name='palm'>{BOX}<body name='a' pos='0 0 .02'><joint name='a' axis='1 0 0' range='0 1.5'/>{BALL}</body>"
    f"<body name='b' pos='0 .03 .02'><joint name='b' axis='1 0 0' range='{{range}}'/>{BALL}</body></body>")


def described(folder: Path, world: str, rest: str = "", compiler: str = "<compiler angle='radian'/>") -> Description:
    path = folder / "hand.xml"
    path.write_text(f"<mujoco>{compiler}<worldbody>{world}</worldbody>{rest}</mujoco>")
    return load_description(path)


def two_joints(folder: Path, rest: str, limits: str = "-3 3") -> Description:
    return described(folder, TWO_JOINTS.format(range=limits), rest)


def warnings_of(description: Description) -> list[str]:
    return [note.text for note in description.notes if note.level == "warning"]


def settled(path: Path, control: float) -> mujoco.MjData:
    """The gripper as its file has it, once it is at rest, touching nothing."""
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.gravity[:] = 0
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    data = mujoco.MjData(model)
    data.ctrl[0] = control
    for _ in range(3000):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    return data


@pytest.mark.parametrize("control", [0.1, 0.4, 0.75])
def test_a_linkage_moves_as_mujoco_simulates_its_ties(tmp_path: Path, control: float) -> None:
    path = write_linkage(tmp_path / "gripper.xml")
    description, data = load_description(path), settled(path, control)
    tree = description.tree
    assert tree.joint_names == ("left_driver",)
    poses = tree.forward(torch.tensor([data.joint("left_driver").qpos[0]], dtype=torch.float32)).numpy()
    for link in ("left_pad", "right_pad", "right_coupler", "left_rocker"):
        T = poses[tree.link_names.index(link)]
        np.testing.assert_allclose(T[:3, 3], data.body(link).xpos, atol=1.5e-3)
        assert math.acos(min(1.0, (np.trace(T[:3, :3].T @ data.body(link).xmat.reshape(3, 3)) - 1) / 2)) < 0.04
    assert not warnings_of(description)


def test_joints_on_one_tendon_that_are_tied_already_are_not_tied_again(tmp_path: Path) -> None:
    description = load_description(write_linkage(tmp_path / "gripper.xml"))
    right = next(c for c in description.couplings if description.tree.moving_names[c.follower] == "right_driver")
    assert (description.tree.moving_names[right.leader], right.multiplier) == ("left_driver", pytest.approx(1.0))


def test_without_actuators_the_joint_nearest_to_the_palm_leads(tmp_path: Path) -> None:
    """A parallelogram: its coupler turns back by what its crank turns."""
    rods = (f"<body name='palm'>{BOX}<body name='crank' pos='0 0 .02'><joint name='crank' axis='1 0 0' range='-1 1'/>{BALL}"
            f"<body name='bar' pos='0 0 .05'><joint name='bar' axis='1 0 0' range='-2 2'/>{BALL}</body></body>"
            f"<body name='rocker' pos='0 .03 .02'><joint name='rocker' axis='1 0 0' range='-2 2'/>{BALL}</body></body>")
    tie = "<equality><connect body1='bar' body2='rocker' anchor='0 .03 0'/></equality>"
    tree = described(tmp_path, rods, tie).tree
    assert tree.joint_names == ("crank",)
    slopes = dict(zip(tree.moving_names, tree.coupling[:, 0].tolist(), strict=True))
    assert slopes == pytest.approx({"crank": 1.0, "bar": -1.0, "rocker": 1.0}, abs=1e-3)


def test_a_tendon_of_constant_length_is_a_coupling(tmp_path: Path) -> None:
    tendon = "<tendon><fixed name='t'><joint joint='a' coef='.4'/><joint joint='b' coef='-.2'/></fixed></tendon>"
    description = two_joints(tmp_path, tendon + "<equality><tendon tendon1='t'/></equality>", "0 3")
    assert [(c.multiplier, c.offset) for c in description.couplings] == [(pytest.approx(2.0), pytest.approx(0.0, abs=1e-4))]
    assert not warnings_of(description)


def test_a_polynomial_becomes_the_line_nearest_to_it(tmp_path: Path) -> None:
    description = two_joints(tmp_path, "<equality><joint joint1='b' joint2='a' polycoef='.1 .5 .4 0 0'/></equality>")
    x = np.linspace(0, 1.5, 33)
    y = 0.1 + 0.5 * x + 0.4 * x**2
    slope, offset = np.polyfit(x, y, 1)
    (coupling,) = description.couplings
    assert (coupling.multiplier, coupling.offset) == (pytest.approx(slope, abs=1e-3), pytest.approx(offset, abs=1e-3))
    missed = np.abs(slope * x + offset - y).max()
    assert warnings_of(description) == [
        f"follows 'a' {slope:.3g} times, as its ties make it, which miss it by up to {missed:.2g}"]


def test_the_leader_goes_as_far_as_the_ties_hold(tmp_path: Path) -> None:
    """b = 2 a, and b ends at 1.2: so a does at 0.6."""
    description = two_joints(tmp_path, "<equality><joint joint1='b' joint2='a' polycoef='0 2 1e-6 0 0'/></equality>"
                             "<actuator><motor joint='a'/></actuator>", "-.1 1.2")
    assert description.tree.joint_names == ("a",)
    assert description.tree.upper.tolist() == [pytest.approx(0.6, abs=1.5 / 32)]
    assert [text for text in warnings_of(description) if "now its limits" in text]


def test_limits_keep_the_unit_of_the_file(tmp_path: Path) -> None:
    world = TWO_JOINTS.format(range="-5 60").replace("0 1.5", "0 90")
    tie = "<equality><joint joint1='b' joint2='a' polycoef='0 2 1e-6 0 0'/></equality><actuator><motor joint='a'/></actuator>"
    tree = described(tmp_path, world, tie, compiler="<compiler angle='degree'/>").tree
    assert tree.upper.tolist() == [pytest.approx(math.radians(30), abs=math.radians(90) / 32)]


def test_a_tie_that_cannot_hold_is_left_out_and_told(tmp_path: Path) -> None:
    # At the reference b is 2 rad from a, beyond its limits.
    world = TWO_JOINTS.format(range="0 .5").replace("name='b' axis", "ref='-2' name='b' axis")
    description = described(tmp_path, world, "<tendon><fixed name='t'><joint joint='a' coef='1'/><joint joint='b' coef='-1'/>"
                            "</fixed></tendon><equality><tendon tendon1='t'/></equality>")
    assert description.tree.joint_names == ("a", "b")
    assert warnings_of(description) == [
        "is a tendon whose length cannot stay within its joints' limits; it is left out, and they move freely"]


def test_what_a_second_leader_moves_is_told(tmp_path: Path) -> None:
    """A finger on two motors: b = a1 + a2 by a tendon; a tree states one of them."""
    second = f"<body name='c' pos='.03 0 .02'><joint name='c' axis='1 0 0' range='0 1'/>{BALL}</body>"
    world = TWO_JOINTS.format(range="-3 3").replace("<body name='b'", f"{second}<body name='b'")
    description = described(
        tmp_path, world, "<tendon><fixed name='t'><joint joint='a' coef='1'/><joint joint='c' coef='1'/>"
        "<joint joint='b' coef='-1'/></fixed></tendon><equality><tendon tendon1='t'/></equality>"
        "<actuator><motor joint='a'/><motor joint='c'/></actuator>")
    assert description.tree.joint_names == ("a", "c")
    assert warnings_of(description) == [
        "follows 'a' 1 times, as its ties make it; that it also moves with 'c' is left out"]


def test_inactive_ties_are_not_there(tmp_path: Path) -> None:
    path = tmp_path / "gripper.xml"
    path.write_text(linkage_xml().replace("<connect ", "<connect active='false' "))
    assert len(load_description(path).tree.joint_names) == 7


@pytest.mark.parametrize(
    ("stated", "absurd", "refused"),
    [('springref="2.5"', 'springref="nan"', "the spring's reference of joint 'right_rocker' is nan"),
     ('stiffness=".05"', 'stiffness="inf"', "the stiffness of joint 'right_rocker' is inf"),
     (f'anchor="{PIN}"', 'anchor="0 .018 nan"', "the coefficients of the tie number 0 is 0 0.018 nan"),
     ('solref=".005 1"', 'solref="-1 1"', None), ('stiffness=".05"', 'stiffness="-1"', None)])
def test_absurd_numbers_are_refused_or_harmless_and_nothing_is_printed(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], stated: str, absurd: str, refused: str | None
) -> None:
    path = tmp_path / "gripper.xml"
    path.write_text(linkage_xml().replace(stated, absurd))
    if refused is None:
        assert "left_driver" in load_description(path).tree.joint_names
    else:
        with pytest.raises(HandError, match=re.escape(refused)):
            load_description(path)
    assert capfd.readouterr() == ("", "")


def test_a_tie_that_no_joint_moves_is_no_loop(tmp_path: Path) -> None:
    """The palm welded to the ground, beside a joint that follows another one."""
    ties = "<equality><joint joint1='b' joint2='a' polycoef='0 .5 0 0 0'/><weld body1='palm'/></equality>"
    description = two_joints(tmp_path, ties)
    assert description.tree.joint_names == ("a",)
    assert not description.notes
