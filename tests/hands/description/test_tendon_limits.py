"""Fixed tendons of one length, by which published MJCF hands make rolling joints. Oracle: the same hand with equalities."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from dro_grasp.hands.check import check_hand
from dro_grasp.hands.library import load_hand
from tests.helpers.claw_urdf import written

BOX = "<geom type='box' size='.006 .006 .02' pos='0 0 .02'/>"


def hand(folder: Path, inside: str, *, ref: str = "0", unit: str = "radian", actuators: str = "la ra") -> Path:
    """Two facing fingers of three hinges, with tendons or equalities."""
    top = "1.4" if unit == "radian" else "80"
    fingers = "".join(
        f"<body name='{n}1' pos='{x} 0 .01'><joint name='{n}a' axis='0 {s} 0' range='0 {top}' ref='{ref}'/>{BOX}"
        f"<body name='{n}2' pos='0 0 .04'><joint name='{n}b' axis='0 {s} 0' range='0 {top}'/>{BOX}"
        f"<body name='{n}3' pos='0 0 .04'><joint name='{n}c' axis='0 {s} 0' range='0 {top}'/>{BOX}</body></body></body>"
        for n, x, s in (("l", -0.035, 1), ("r", 0.035, -1)))
    moved = "".join(f"<position joint='{name}' kp='1' forcerange='-1 1'/>" for name in actuators.split())
    text = (f"<mujoco><compiler angle='{unit}' autolimits='true'/><worldbody><body name='palm'>"
            f"<geom type='box' size='.04 .04 .01'/>{fingers}</body></worldbody>{inside}<actuator>{moved}</actuator></mujoco>")
    return written(folder, text, "hand.xml")


def tendons(first: str, second: str, length: str, *coefs: float, more: str = "") -> str:
    one = "".join(f"<fixed name='{n}{first}{second}' range='{length}' {more}><joint joint='{n}{first}' coef='{coefs[0]}'/>"
                  f"<joint joint='{n}{second}' coef='{coefs[1]}'/></fixed>" for n in "lr")
    return f"<tendon>{one}</tendon>"


def equalities(follower: str, leader: str, offset: float, ratio: float) -> str:
    return "<equality>" + "".join(f"<joint joint1='{n}{follower}' joint2='{n}{leader}' polycoef='{offset} {ratio} 0 0 0'/>"
                                  for n in "lr") + "</equality>"


def same_motion(first: Path, second: Path) -> None:
    one, other = load_hand(first), load_hand(second)
    assert one.tree.joint_names == other.tree.joint_names
    for x in (0.0, 0.5, 1.0):
        q = torch.lerp(one.tree.lower, one.tree.upper, x)
        torch.testing.assert_close(one.tree.forward(q), other.tree.forward(q), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(("tie", "equal"), [
    (tendons("a", "b", "-0.001 0.001", 1, -1), equalities("b", "a", 0, 1)),
    (tendons("b", "a", "-0.001 0.001", 1, -0.7), equalities("b", "a", 0, 0.7)),
    (tendons("a", "b", "0.199 0.201", 1, 2), equalities("b", "a", 0.1, -0.5)),
    (tendons("b", "c", "-0.001 0.001", 1, -1), equalities("c", "b", 0, 1)),
    (tendons("a", "b", "-0.001 0.001", 1, -1) + tendons("b", "c", "-1e-3 1e-3", 0.5, -1),
     equalities("b", "a", 0, 1) + equalities("c", "b", 0, 0.5)),
    (tendons("b", "c", "-1e-3 1e-3", 0.5, -1) + tendons("a", "b", "-0.001 0.001", 1, -1),
     equalities("b", "a", 0, 1) + equalities("c", "b", 0, 0.5))])
def test_a_tendon_of_one_length_ties_its_joints(tmp_path: Path, tie: str, equal: str) -> None:
    (tmp_path / "stated").mkdir()
    same_motion(hand(tmp_path, tie), hand(tmp_path / "stated", equal))
    assert any("is limited to one value" in note.text for note in check_hand(tmp_path / "hand.xml").notes)


def test_reference_angles_and_degrees_are_honoured(tmp_path: Path) -> None:
    """The length counts the angles themselves, an equality those from the references on."""
    for name in ("radians", "degrees"):
        (tmp_path / name).mkdir()
    tie = tendons("a", "b", "0.299 0.301", 1, -1)
    radians = load_hand(hand(tmp_path / "radians", tie, ref="0.2"))
    degrees = load_hand(hand(tmp_path / "degrees", tie, ref=str(0.2 * 57.29577951), unit="degree"))
    for read in (radians, degrees):
        a, b = (read.tree.moving_names.index(name) for name in ("la", "lb"))
        q = read.tree.coupling @ torch.full((read.tree.n_dof,), 0.9).to(read.tree.coupling) + read.tree.offset
        assert float(q[a] - q[b]) == pytest.approx(0.3, abs=1e-4)


def test_the_joint_that_is_driven_leads(tmp_path: Path) -> None:
    tie = tendons("a", "b", "-0.001 0.001", 1, -1)
    assert load_hand(hand(tmp_path, tie, actuators="lb rb")).tree.joint_names == ("lb", "lc", "rb", "rc")
    assert load_hand(hand(tmp_path, tie, actuators="la lb ra rb")).tree.n_dof == 6


@pytest.mark.parametrize("tie", [
    tendons("a", "b", "-0.5 0.5", 1, -1), tendons("a", "b", "-0.001 0.001", 1, -1, more="limited='false'"),
    tendons("a", "b", "0 0", 1, -1), tendons("a", "b", "-0.001 0.001", 1, -0.01)])
def test_tendons_with_play_or_without_limits_tie_nothing(tmp_path: Path, tie: str) -> None:
    assert load_hand(hand(tmp_path, tie)).tree.n_dof == 6
