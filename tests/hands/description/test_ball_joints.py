"""Ball joints, and rods with balls at their ends that motors push. Oracle: MuJoCo, settled under its own ties."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from dro_grasp.errors import HandError
from dro_grasp.hands.check import check_hand
from dro_grasp.hands.description.loader import load_description
from dro_grasp.hands.library import load_hand
from tests.helpers.claw_urdf import written

DRAWN = "contype='0' conaffinity='0'"
LONG = 0.012  # of cranks [m]


def drive(name: str, x: float, y: float, side: float, slanted: float = 0.0) -> str:
    """A motor below the palm whose crank pushes a rod up to a finger."""
    e = LONG * side
    return f"""<body name="{name}_crank" pos="{x} {y} -.03"><joint name="{name}_motor" axis="0 {side} 0" range="-1 1"/>
      <geom type="box" size=".006 .002 .004" pos="{e / 2} 0 0" {DRAWN}/><body name="{name}_rod" pos="{e} 0 0">
      <joint name="{name}_ball" type="ball"/><geom type="capsule" size=".002" fromto="0 0 0 0 {slanted} .04" {DRAWN}/>
      <site name="{name}_end" pos="0 {slanted} .04"/></body></body>"""


def one_motor(name: str, x: float, side: float) -> str:
    """A finger that one rod bends, and whose rod stands aslant."""
    return drive(name, x, 0.012, side, -0.008) + f"""<body name="{name}" pos="{x} 0 .01"><joint name="{name}_bend"
      axis="0 {side} 0" range="-.2 1.4"/><geom type="box" size=".006 .006 .03" pos="0 0 .03"/><geom type="box"
      size=".007 .006 .002" pos="{LONG * side / 2} 0 0"/><site name="{name}_hole" pos="{LONG * side} .004 0"/></body>"""


def two_motors(name: str, x: float, side: float) -> str:
    """A finger that two rods bend together, and spread against each other."""
    e = LONG * side
    return drive(f"{name}1", x, -0.012, side) + drive(f"{name}2", x, 0.012, side) + f"""<body name="{name}_base"
      pos="{x} 0 .01"><joint name="{name}_spread" axis="1 0 0" range="-.4 .4"/><body name="{name}"><joint name="{name}_bend"
      axis="0 {side} 0" range="-.2 1.4"/><geom type="box" size=".006 .006 .03" pos="0 0 .03"/><geom type="box"
      size=".007 .013 .002" pos="{e / 2} 0 0"/><site name="{name}1_hole" pos="{e} -.012 0"/>
      <site name="{name}2_hole" pos="{e} .012 0"/></body></body>"""


def mjcf(fingers: str, rods: tuple[str, ...] = (), more: str = "") -> str:
    ties = "".join(f'<connect site1="{rod}_end" site2="{rod}_hole"/>' for rod in rods)
    motors = "".join(f'<position joint="{rod}_motor" kp="9" forcerange="-1 1"/>' for rod in rods)
    return (f'<mujoco><compiler angle="radian" boundmass=".01" boundinertia="1e-6"/><option gravity="0 0 0"/><worldbody>'
            f'<body name="palm"><geom type="box" size=".04 .04 .01" {DRAWN}/>{fingers}</body></worldbody>'
            f"<equality>{ties}</equality><actuator>{motors}{more}</actuator></mujoco>")


def pair(finger) -> str:
    return finger("l", -0.035, 1.0) + finger("r", 0.035, -1.0)


def settled(path: Path, values: dict[str, float]) -> mujoco.MjData:
    """The file's own mechanism, pulled towards some values by its motors."""
    model = mujoco.MjModel.from_xml_path(str(path))
    model.dof_damping[:] = 0.05
    data = mujoco.MjData(model)
    for actuator in range(model.nu):
        data.ctrl[actuator] = values[model.joint(int(model.actuator_trnid[actuator, 0])).name]
    for _ in range(4000):
        mujoco.mj_step(model, data)
    return data


@pytest.mark.parametrize("value", [0.2, 0.45])
def test_a_finger_follows_the_motor_of_its_rod(tmp_path: Path, value: float) -> None:
    path = written(tmp_path, mjcf(pair(one_motor), ("l", "r")), "hand.xml")
    tree, data = load_description(path).tree, settled(path, {"l_motor": value, "r_motor": value})
    assert tree.joint_names == ("l_motor", "r_motor")
    q = torch.tensor([data.joint(name).qpos[0] for name in tree.joint_names], dtype=torch.float32)
    assert float(q.min()) > 0.15
    for link in ("l", "r", "l_rod", "r_rod"):
        pose = tree.forward(q)[tree.link_names.index(link)].numpy()
        np.testing.assert_allclose(pose[:3, 3], data.body(link).xpos, atol=1e-3)
        np.testing.assert_allclose(pose[:3, 2], data.body(link).xmat.reshape(3, 3)[:, 2], atol=0.03)


def test_rods_on_balls_are_no_fingertips(tmp_path: Path) -> None:
    report = check_hand(written(tmp_path, mjcf(pair(one_motor), ("l", "r")), "hand.xml"))
    assert report.facts["fingertips"] == ["l", "r"]
    assert {note.subject: note.text for note in report.notes if note.subject == "l_ball"} == {
        "l_ball": "is a ball joint, taken as three hinges, l_ball_x, l_ball_y, l_ball_z"}


def test_a_finger_that_two_rods_move_leads_itself(tmp_path: Path) -> None:
    path = written(tmp_path, mjcf(pair(two_motors), ("l1", "l2", "r1", "r2")), "hand.xml")
    report = check_hand(path)
    assert report.facts["fingertips"] == ["l", "r"]
    assert report.hand.tree.joint_names == ("l_spread", "l_bend", "r_spread", "r_bend")
    assert not report.hand.tree.n_links - len({"palm", "l_base", "l", "r_base", "r"})
    told = {note.subject: note.text for note in report.notes}
    assert told["l_spread"] == "is moved by l1_motor and l2_motor together; grasps state its values, not theirs"
    assert "left out" in told["l1_crank"]
    data = settled(path, dict.fromkeys(("l1_motor", "l2_motor", "r1_motor", "r2_motor"), 0.5))
    bend = data.joint("l_bend").qpos[0]
    assert 0.35 < bend < float(report.hand.tree.upper[1]), "what the rods reach is within its limits"


def test_a_ball_that_a_motor_moves_is_three_hinges(tmp_path: Path) -> None:
    box = "<geom type='box' size='.006 .006 .03' pos='0 0 .03'/>"
    fingers = "".join(f"<body name='{n}' pos='{x} 0 .01'><joint name='{n}' type='ball' range='0 .8'/>{box}</body>"
                      for n, x in (("a", -0.035), ("b", 0.035)))
    motors = "<motor joint='a' gear='0 2 0' forcerange='-1 1'/><motor joint='b' gear='0 2 0'/>"
    path = written(tmp_path, mjcf(fingers, (), motors), "hand.xml")
    description = load_description(path)
    tree, model = description.tree, mujoco.MjModel.from_xml_path(str(path))
    assert tree.joint_names == ("a_x", "a_y", "a_z", "b_x", "b_y", "b_z")
    assert tree.upper.tolist() == pytest.approx([0.8] * 6)
    assert description.efforts[0] == pytest.approx(2.0)
    q, data = torch.tensor([0.1, 0.5, -0.3, 0.4, -0.2, 0.6]), mujoco.MjData(model)
    for ball, angles in (("a", q[:3]), ("b", q[3:])):
        turns = [np.zeros(4) for _ in range(3)]
        for turn, axis, angle in zip(turns, np.eye(3), angles.tolist(), strict=True):
            mujoco.mju_axisAngle2Quat(turn, axis, angle)
        first, whole = np.zeros(4), np.zeros(4)
        mujoco.mju_mulQuat(first, turns[0], turns[1])
        mujoco.mju_mulQuat(whole, first, turns[2])
        data.joint(ball).qpos[:] = whole
    mujoco.mj_kinematics(model, data)
    for link in ("a", "b"):
        pose = tree.forward(q)[tree.link_names.index(link), :3, :3].numpy()
        np.testing.assert_allclose(pose, data.body(link).xmat.reshape(3, 3), atol=1e-5)
    assert len(load_hand(path).fingers) == 2


def test_a_hand_on_a_ball_is_free(tmp_path: Path) -> None:
    fingers = pair(one_motor)
    text = mjcf(fingers, ("l", "r")).replace('<body name="palm">', '<body name="palm"><joint name="wrist" type="ball"/>')
    description = load_description(written(tmp_path, text, "hand.xml"))
    assert description.tree.joint_names == ("l_motor", "r_motor")
    assert [note.text for note in description.notes if note.subject == "wrist"] == [
        "moves the whole hand and is left out: the wrist of a grasp is free anyway"]


def test_a_ball_before_another_joint_of_its_link_is_refused(tmp_path: Path) -> None:
    body = "<body name='f' pos='0 0 .02'><joint name='ball' type='ball'/>" \
           "<joint name='hinge' range='0 1'/><geom size='.01'/></body>"
    with pytest.raises(HandError, match="joint 'ball' is a ball joint before another joint of link 'f'"):
        load_description(written(tmp_path, mjcf(body), "hand.xml"))
