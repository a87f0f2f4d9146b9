"""Efforts are those of the file, of its actuators where joints state none, or what suits the hand where none is believed."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from dro_grasp.hands.check import check_hand
from dro_grasp.hands.effort import TIP_FORCE, find_efforts, suited_efforts
from dro_grasp.hands.library import load_hand
from dro_grasp.simulation.payload import servo_torques
from dro_grasp.simulation.protocols import PROTOCOLS
from dro_grasp.simulation.scene import build_scene
from tests.helpers.claw import JAWS, ball, claw_xml
from tests.helpers.claw_urdf import claw, joint, link, written


def with_efforts(folder: Path, a: str, b: str) -> Path:
    limits = [f'<limit lower="0" upper="1.5" {effort} velocity="1"/>' for effort in (a, b)]
    joints = joint("a", "palm", "left", "-0.035 0 0.01", more=limits[0])
    return written(folder, claw(joints=joints + joint("b", "palm", "right", "0.035 0 0.01", "0 -1 0", limits[1])))


def test_what_a_urdf_states_is_taken_and_nonsense_is_not(tmp_path: Path) -> None:
    hand = load_hand(with_efforts(tmp_path, 'effort="0.8"', 'effort="1000"'))
    found, suited = find_efforts(hand), suited_efforts(hand)
    assert found.stated.tolist() == [True, False]
    assert found.limit.tolist() == pytest.approx([0.8, float(suited[1])])


def test_the_check_says_which_efforts_were_not_believed(tmp_path: Path) -> None:
    report = check_hand(with_efforts(tmp_path, 'effort="0"', 'effort="0.8"'))
    (note,) = (n for n in report.notes if "effort" in n.text)
    assert note.subject == "a"
    assert report.facts["effort"]["b"] == 0.8
    assert not any("effort" in n.text for n in check_hand(with_efforts(tmp_path, 'effort="1"', 'effort="1"')).notes)


@pytest.mark.parametrize(("text", "told"), [
    (JAWS, "with which jaws that slide press by 40 N"), (claw_xml(2), "with which fingertips press by 10 N"),
    (JAWS.replace('name="slide_left" type="slide" axis="1 0 0" range="-0.03 0.02"',
                  'name="turn" axis="0 1 0" pos="0 0 -0.05" range="-20 20"'),
     "with which fingertips press by 10 N and jaws that slide press by 40 N")], ids=["slides", "turns", "both"])
def test_what_is_taken_is_told_by_how_it_presses(tmp_path: Path, text: str, told: str) -> None:
    (note,) = (n for n in check_hand(written(tmp_path, text, "hand.xml")).notes if "state no effort" in n.text)
    assert note.text.endswith(told)


def test_what_suits_a_hand_lets_its_tips_press_by_the_force_that_is_named(tmp_path: Path) -> None:
    hand = load_hand(with_efforts(tmp_path, 'effort="1"', 'effort="1"'))
    tree, step = hand.tree, 1e-5
    tips = torch.tensor(hand.tips)

    def places(q: torch.Tensor) -> torch.Tensor:
        poses = tree.forward(q)[tips].double()
        return (poses[:, :3, :3] @ hand.tip_offsets.double()[..., None])[..., 0] + poses[:, :3, 3]

    q = hand.open_ends.double()
    tree = tree.to(dtype=torch.float64)
    for i, torque in enumerate(suited_efforts(hand).tolist()):
        moved = q.clone()
        moved[i] += step
        levers = ((places(moved) - places(q)) / step).norm(dim=-1)
        assert torque == pytest.approx(TIP_FORCE * float(levers.sum()), rel=1e-3)


@pytest.mark.parametrize(("actuator", "expected"), [
    ("<position joint='base0' forcerange='-0.7 0.7'/>", 0.7),
    ("<general joint='base0' gear='2' forcerange='-0.3 0.3'/>", 0.6),
    ("<motor joint='base0' gear='3' ctrllimited='true' ctrlrange='-0.2 0.2'/>", 0.6),
])
def test_actuators_of_an_mjcf_state_the_effort_of_their_joint(tmp_path: Path, actuator: str, expected: float) -> None:
    text = claw_xml().replace(' actuatorfrcrange="-0.001 0.001"', "").replace(
        "</mujoco>", f"<actuator>{actuator}</actuator></mujoco>")
    (tmp_path / "hand.xml").write_text(text)
    # MuJoCo's own largest force at the joint, with all controls as far as they go.
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.ctrl[:] = model.actuator_ctrlrange[:, 1] if model.actuator_ctrllimited.all() else 1e6
    mujoco.mj_forward(model, data)
    assert np.abs(data.qfrc_actuator).max() == pytest.approx(expected)
    hand = load_hand(tmp_path / "hand.xml")
    told = dict(zip(hand.tree.joint_names, hand.description.efforts.tolist(), strict=True))
    assert told["base0"] == pytest.approx(expected)
    assert np.isnan(told["knuckle0"])


@pytest.mark.parametrize(("stated", "expected"), [("-0.5 0.5", 0.5), ("-4 4", 0.7)])
def test_a_joint_is_as_strong_as_the_weaker_of_itself_and_its_actuator(tmp_path: Path, stated: str, expected: float) -> None:
    text = claw_xml().replace('actuatorfrcrange="-0.001 0.001"', f'actuatorfrcrange="{stated}"').replace(
        "</mujoco>", "<actuator><position joint='base0' forcerange='-0.7 0.7'/></actuator></mujoco>")
    (tmp_path / "hand.xml").write_text(text)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.ctrl[:] = 1e6
    mujoco.mj_forward(model, data)
    assert np.abs(data.qfrc_actuator).max() == pytest.approx(expected)
    hand = load_hand(tmp_path / "hand.xml")
    assert dict(zip(hand.tree.joint_names, hand.description.efforts.tolist(), strict=True))["base0"] == pytest.approx(expected)


@pytest.mark.parametrize("coefs", [(1.0, 1.0), (1.0, -2.0), (0.5, 2.0)])
def test_the_leader_of_joints_on_a_tendon_does_the_work_of_all(tmp_path: Path, coefs: tuple[float, float]) -> None:
    """Oracle: virtual work of MuJoCo's own forces at both joints, as one length of the tendon moves them."""
    fixed = "".join(f"<joint joint='{name}' coef='{c}'/>" for name, c in zip(("base0", "knuckle0"), coefs, strict=True))
    text = claw_xml().replace(' actuatorfrcrange="-0.001 0.001"', "").replace(
        "</mujoco>", f"<tendon><fixed name='t'>{fixed}</fixed></tendon>"
        "<actuator><general tendon='t' gear='2' forcerange='-0.3 0.3'/></actuator></mujoco>")
    (tmp_path / "hand.xml").write_text(text)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.ctrl[:] = 1e6
    mujoco.mj_forward(model, data)
    forces = [data.qfrc_actuator[model.joint(name).dofadr[0]] for name in ("base0", "knuckle0")]
    work = forces[0] + forces[1] * coefs[0] / coefs[1]
    hand = load_hand(tmp_path / "hand.xml")
    assert "knuckle0" not in hand.tree.joint_names
    assert hand.description.efforts[hand.tree.joint_names.index("base0")] == pytest.approx(abs(work))


def test_a_slide_that_turns_fingers_by_rods_has_the_unit_of_its_servo(tmp_path: Path) -> None:
    rod = ('<joint name="rod" type="prismatic"><parent link="palm"/><child link="rod"/><axis xyz="0 0 1"/>'
           '<limit lower="0" upper="0.016" effort="60" velocity="1"/></joint>')
    turns = ['<limit lower="0" upper="0.8" effort="1" velocity="1"/><mimic joint="rod" multiplier="50"/>'] * 2
    path = written(tmp_path, claw(
        links=link("left") + link("right") + link("rod", '<box size="0.01 0.01 0.01"/>'),
        joints=rod + joint("a", "palm", "left", "-0.035 0 0.01", more=turns[0])
        + joint("b", "palm", "right", "0.035 0 0.01", "0 -1 0", turns[1])))
    hand, rules = load_hand(path), PROTOCOLS["carry"]
    model = build_scene(hand, ball(), rules).model
    assert hand.tree.joint_names == ("rod",)
    stiffness = model.actuator_gainprm[0, 0]
    assert rules.stiffness / float(hand.tree.joint_unit[0]) ** 2 == pytest.approx(stiffness)
    assert float(servo_torques(hand, torch.tensor([0.001]), torch.tensor([0.002]), rules)) == pytest.approx(
        0.001 * stiffness, rel=1e-4)


def test_servos_of_carry_end_at_the_effort_and_those_of_strict_do_not(tmp_path: Path) -> None:
    hand = load_hand(with_efforts(tmp_path, 'effort="0.8"', 'effort="0.9"'))
    scenes = {name: build_scene(hand, ball(), PROTOCOLS[name]) for name in ("carry", "strict")}
    limits = {name: scene.model.actuator_forcerange[:, 1].tolist() for name, scene in scenes.items()}
    assert sorted(limits["carry"]) == pytest.approx([0.8, 0.9])
    assert limits["strict"] == [20.0, 20.0]
