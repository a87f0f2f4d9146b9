"""Which last links of a hand are rods of a linkage, and whose."""

from __future__ import annotations

from pathlib import Path

import pytest

from dro_grasp.hands.anatomy import find_rods, find_tips
from dro_grasp.hands.build import build_hand
from dro_grasp.hands.description.loader import load_description
from tests.helpers.linkage_gripper import write_linkage
from tests.helpers.loaded_hands import loaded_hand

ROBOT = """<robot name="jaws"><link name="palm">{box}</link>{links}</robot>"""
BOX = '<collision><geometry><box size=".03 .03 .03"/></geometry></collision>'


def urdf(folder: Path, *fingers: tuple[str, str, float, float]) -> Path:
    """Rods that hinge about x and follow the first one, each on the palm or another one, at some place and so long [m]."""
    links = ""
    for number, (parent, place, ratio, length) in enumerate(fingers):
        follows = f'<mimic joint="j0" multiplier="{ratio}"/>' if number else ""
        links += (
            f'<link name="l{number}"><collision><origin xyz="0 0 {length / 2}"/><geometry><box size=".01 .01 {length}"/>'
            f'</geometry></collision></link><joint name="j{number}" type="revolute"><parent link="{parent}"/>'
            f'<child link="l{number}"/><origin xyz="{place}"/><axis xyz="1 0 0"/>'
            f'<limit lower="-2" upper="2" effort="1" velocity="1"/>{follows}</joint>')
    path = folder / "jaws.urdf"
    path.write_text(ROBOT.format(box=BOX, links=links).replace('lower="-2" upper="2"', 'lower="0" upper="1"', 1))
    return path


def rods(path: Path) -> dict[str, str]:
    description = load_description(path)
    tree, shaped = description.tree, {g.link for g in description.geometry}
    found = find_rods(tree, find_tips(tree, shaped), description.geometry)
    return {tree.link_names[rod]: tree.link_names[finger] for rod, finger in found.items()}


def test_the_couplers_of_a_gripper_are_no_fingertips(tmp_path: Path) -> None:
    hand = build_hand(load_description(write_linkage(tmp_path / "gripper.xml")))
    names = hand.tree.link_names
    fingers = {names[finger.tip]: {names[link] for link in finger.links} for finger in hand.fingers}
    assert fingers == {f"{side}_pad": {f"{side}_{part}" for part in ("driver", "coupler", "rocker", "finger", "pad")}
                       for side in ("right", "left")}
    assert hand.palm_direction[2] > 0.9


def test_a_parallelogram_stated_by_mimic_joints_is_a_finger(tmp_path: Path) -> None:
    """A crank and a rocker side by side, and on the crank a finger that turns back as far as both turn."""
    path = urdf(tmp_path, ("palm", "0 0 0", 1, 0.06), ("palm", "0 .02 0", 1, 0.06), ("l0", "0 0 .06", -1, 0.08))
    text = path.read_text()
    # The finger is wide enough to have the rocker's pin.
    path.write_text(text.replace('<box size=".01 .01 0.08"/>', '<box size=".01 .05 0.08"/>'))
    assert rods(path) == {"l1": "l2"}


@pytest.mark.parametrize(
    ("second", "ratio"), [("0 0 0", -1.0), ("0 .02 0", -1.0), ("0 .02 0", 1.0), ("0 .02 0", 0.5)],
    ids=["scissors", "jaws", "side by side", "one slower than the other"])
def test_fingers_on_one_joint_are_no_rods(tmp_path: Path, second: str, ratio: float) -> None:
    assert rods(urdf(tmp_path, ("palm", "0 0 0", 1, 0.06), ("palm", second, ratio, 0.06))) == {}


@pytest.mark.parametrize("name", ["barrett", "gripper3", "shadowhand"])
def test_built_in_hands_have_none(name: str) -> None:
    hand = loaded_hand(name)
    assert hand.description is not None
    assert find_rods(hand.tree, hand.tips, hand.description.geometry) == {}
