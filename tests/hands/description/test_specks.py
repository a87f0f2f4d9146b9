"""Links that stand for motors: joints that turn nothing but a speck are no fingers. Oracle: the same hand without them."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from dro_grasp.hands.check import check_hand
from dro_grasp.hands.library import load_hand
from tests.helpers.claw_urdf import LIMIT, claw, joint, link, written

MOTOR = joint("motor", "palm", "drive", "0 0 0", "0 0 1", '<limit lower="-3" upper="6.8" effort="2" velocity="1"/>')
SHAPES = ('<sphere radius="0.001"/>', '<box size="0.002 0.002 0.002"/>', '<cylinder radius="0.001" length="0.002"/>')


@pytest.mark.parametrize("shape", SHAPES)
def test_a_joint_that_moves_nothing_but_a_speck_is_no_finger(tmp_path: Path, shape: str) -> None:
    (tmp_path / "plain").mkdir()
    plain = load_hand(written(tmp_path / "plain", claw()))
    report = check_hand(written(tmp_path, claw(link("drive", shape) + MOTOR)))
    assert report.facts["fingertips"] == ["left", "right"]
    assert report.facts["free_joints"] == ["a", "b"]
    torch.testing.assert_close(report.hand.palm_direction_wrist, plain.palm_direction_wrist, atol=1e-3, rtol=0.0)
    assert ["stand for motors" in note.text for note in report.notes if note.subject == "motor"] == [True]


def test_a_motor_on_a_motor_is_none_either(tmp_path: Path) -> None:
    two = link("drive", SHAPES[0]) + MOTOR + link("gear", SHAPES[0]) + joint("gears", "drive", "gear", "0 0 0")
    assert load_hand(written(tmp_path, claw(two))).tree.joint_names == ("a", "b")


def test_a_motor_that_joints_follow_leads_them(tmp_path: Path) -> None:
    follow = LIMIT + '<mimic joint="motor"/>'
    joints = (joint("a", "palm", "left", "-0.035 0 0.01", more=follow)
              + joint("b", "palm", "right", "0.035 0 0.01", "0 -1 0", follow))
    hand = load_hand(written(tmp_path, claw(link("drive", SHAPES[0]) + MOTOR, joints=joints)))
    assert hand.tree.joint_names == ("motor",)


def test_small_links_within_a_finger_and_small_fingers_stay(tmp_path: Path) -> None:
    chain = (link("left", SHAPES[0]) + link("right") + link("tip")
             + joint("c", "left", "tip", "0 0 0.01"))
    assert load_hand(written(tmp_path, claw(links=chain))).tree.joint_names == ("a", "c", "b")
    small = link("third", '<sphere radius="0.004"/>') + joint("d", "palm", "third", "0 0.03 0.02", "1 0 0")
    assert len(load_hand(written(tmp_path, claw(small))).tips) == 3


def test_a_hand_of_nothing_but_specks_keeps_its_joints(tmp_path: Path) -> None:
    tiny = claw(links=link("left", SHAPES[0]) + link("right", SHAPES[0]))
    assert load_hand(written(tmp_path, tiny)).tree.joint_names == ("a", "b")
