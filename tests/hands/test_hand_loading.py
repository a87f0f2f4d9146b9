"""Descriptions that are wrong, told in words, and odd ones that must work."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch
import trimesh

import dro_grasp as dro
from dro_grasp.errors import HandError, OptionError
from tests.helpers.claw_urdf import LIMIT, claw, joint, link, meshed, written


def test_a_plain_claw_loads_and_its_file_stays_as_it_was(tmp_path: Path) -> None:
    path = written(tmp_path, claw())
    hand = dro.load_hand(path)
    assert hand.name == "claw"
    assert hand.tree.n_dof == 2
    assert path.read_text() == claw()
    assert [p.name for p in tmp_path.iterdir()] == ["claw.urdf"]


BOMB = '<!DOCTYPE r [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;">]>'
READER = '<!DOCTYPE r [<!ENTITY a SYSTEM "file:///etc/passwd">]>'


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("not XML at all", "not valid XML"),
        ("", "not valid XML"),
        (claw()[:-20], "not valid XML"),
        (BOMB + claw("<!-- -->").replace("</robot>", "&b;</robot>"), "<!ENTITY"),
        (READER + claw().replace("</robot>", "&a;</robot>"), "<!ENTITY"),
        ("<html></html>", "expected a URDF (<robot>) or MJCF (<mujoco>) file"),
        ('<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:macro name="m"/></robot>', "expand it first"),
        ('<robot name="empty"/>', "no <link>"),
        (claw(joints=joint("a", "palm", "left", "0 0 0", kind="fixed") + joint("b", "palm", "right", "0 0 0", kind="fixed")),
         "no moving joint"),
        (claw(joints=joint("a", "left", "right", "0 0 0.06") + joint("b", "right", "left", "0 0 0.06")), "cycle"),
        (claw(joints=joint("a", "palm", "left", "0 0 0")), "2 root links"),
        (claw(joint("c", "left", "right", "0 0 0.06")), "two parents"),
        (claw(joints=joint("a", "palm", "lost", "0 0 0") + joint("b", "palm", "right", "0 0 0")), "'lost', which"),
        (claw(joints=joint("a", "palm", "left", "0 0 0", more='<limit lower="1" upper="-1" effort="1" velocity="1"/>')
              + joint("b", "palm", "right", "0 0 0")), "swap them"),
        (claw(joints=joint("a", "palm", "left", "0 0 0", "0 0 0") + joint("b", "palm", "right", "0 0 0")), "not all zero"),
        (claw(joints=joint("a", "palm", "left", "0 0 nan") + joint("b", "palm", "right", "0 0 0", "0 x 0")), "finite numbers"),
        (claw(joints=joint("a", "palm", "left", "0 0 0", kind="rotary") + joint("b", "palm", "right", "0 0 0")), "'rotary'"),
        (claw(joints=joint("a", "palm", "left", "0 0 0", more=LIMIT + '<mimic joint="b"/>')
              + joint("b", "palm", "right", "0 0 0", more=LIMIT + '<mimic joint="a"/>')), "cycle (a -> b -> a)"),
        (claw(joints=joint("a", "palm", "left", "0 0 0", more=LIMIT + '<mimic joint="a"/>')
              + joint("b", "palm", "right", "0 0 0")), "joint 'a' follows itself"),
        (claw(links=link("left") + link("right") + link("tip"),
              joints=joint("a", "palm", "left", "0 0 0", more=LIMIT + '<mimic joint="b"/>')
              + joint("b", "palm", "right", "0 0 0", more=LIMIT + '<mimic joint="c"/>')
              + joint("c", "right", "tip", "0 0 0", more=LIMIT + '<mimic joint="a"/>')), "cycle (a -> b -> c -> a)"),
        (claw(joints=joint("a", "palm", "left", "0 0 0") + joint("a", "palm", "right", "0 0 0")), "two joints are called 'a'"),
        (claw(link("left")), "two links are called 'left'"),
        (claw(joints=joint("a", "palm", "left", "nan 0 0") + joint("b", "palm", "right", "0 0 0")), "of link 'left' is nan"),
        (claw(links=link("left").replace("0 0 0.03", "0 inf 0") + link("right")), "of link 'left' is 0 inf"),
        (claw(links=link("left", '<sphere radius="big"/>') + link("right")), "link 'left' has radius=\"big\""),
    ],
)
def test_bad_urdf_is_refused(tmp_path: Path, text: str, told: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(HandError) as error:
        dro.load_hand(path)
    assert told in str(error.value)
    assert str(path) in str(error.value)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('<mujoco><include file="nowhere.xml"/></mujoco>', "includes 'nowhere.xml', which does not exist"),
        ("<mujoco><worldbody/></mujoco>", "no body"),
        ('<mujoco><worldbody><body><geom size="0.1"/></body></worldbody></mujoco>', "no moving joint"),
        ('<mujoco><worldbody><body><geom size="0.1"/><body><joint type="ball"/><geom size="0.1"/></body></body></worldbody>'
         "</mujoco>", "enclose no space"),
        ('<mujoco><asset><mesh name="m" file="m.stl"/></asset><worldbody><body><joint/><geom type="mesh" mesh="m"/></body>'
         "</worldbody></mujoco>", "m.stl"),
        ('<mujoco><worldbody><body><hinge/></body></worldbody></mujoco>', "hinge"),
        ('<mujoco><worldbody><body><geom size="0.05"/><body><joint name="j" axis="1 0 0" range="0 1"/><geom size="0.05"/>'
         '</body></body></worldbody><equality><joint joint1="j" joint2="j"/></equality></mujoco>', "joint 'j' follows itself"),
    ],
)
def test_bad_mjcf_is_refused(tmp_path: Path, text: str, told: str) -> None:
    path = written(tmp_path, text, "hand.xml")
    with pytest.raises(HandError) as error:
        dro.load_hand(path)
    assert told in str(error.value)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_path_that_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(HandError, match="is a folder"):
        dro.load_hand(tmp_path)
    with pytest.raises(HandError, match="no hand description at"):
        dro.load_hand(tmp_path / "nowhere.urdf")


def test_an_unknown_name_names_near_ones_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dro_grasp.hands.library.hand_names", lambda: {"barrett": "builtin", "assets/barrett": "assets"})
    with pytest.raises(HandError, match=r"Perhaps you meant barrett\. Known: barrett, assets/barrett;"):
        dro.load_hand("barett")


@pytest.mark.parametrize(("limit", "ends"), [('upper="1.2"', [0, 1.2]), ('lower="-0.4"', [-0.4, 0])])
def test_a_limit_left_out_is_zero(tmp_path: Path, limit: str, ends: list[float]) -> None:
    """As URDF has it."""
    text = claw(joints=joint("a", "palm", "left", "-0.035 0 0.01", more=f"<limit {limit} effort='1' velocity='1'/>")
                + joint("b", "palm", "right", "0.035 0 0.01", "0 -1 0"))
    tree = dro.load_hand(written(tmp_path, text)).tree
    assert [float(tree.lower[0]), float(tree.upper[0])] == pytest.approx(ends)


@pytest.mark.parametrize("name", ["../meshes/finger.stl", "package://my_hand/meshes/finger.stl", "file://{folder}/meshes/finger.stl"])
def test_meshes_are_found_where_descriptions_put_them(tmp_path: Path, name: str) -> None:
    for folder in ("urdf", "meshes"):
        (tmp_path / "my_hand" / folder).mkdir(parents=True)
    trimesh.creation.box((0.012, 0.02, 0.06)).export(tmp_path / "my_hand" / "meshes" / "finger.stl")
    path = written(tmp_path / "my_hand" / "urdf", meshed(name.format(folder=tmp_path / "my_hand")))
    hand = dro.load_hand(path)
    finger = hand.link_points[hand.link_index == hand.tree.link_names.index("left")]
    torch.testing.assert_close(finger.abs().amax(0)[:2], torch.tensor([0.006, 0.01]), atol=2e-4, rtol=0)


def test_a_hand_of_lost_meshes_only_is_refused(tmp_path: Path) -> None:
    text = claw(links=link("left", '<mesh filename="l.stl"/>') + link("right", '<mesh filename="r.stl"/>'))
    text = text.replace('<box size="0.08 0.08 0.02"/>', '<mesh filename="p.stl"/>')
    with pytest.raises(HandError, match=r"none of its 3 meshes can be found .*looked for .*p\.stl"):
        dro.load_hand(written(tmp_path, text))


def test_a_broken_mesh_is_named(tmp_path: Path) -> None:
    (tmp_path / "finger.stl").write_text("solid nothing")
    with pytest.raises(HandError, match=r"finger\.stl"):
        dro.load_hand(written(tmp_path, meshed("finger.stl")))


@pytest.mark.parametrize(("factor", "lengths", "told"), [
    (1000, "size=|<origin xyz=", "looks like millimetres"), (0.1, "size=|<origin xyz=", "another unit"),
    (1000, "size=", "looks like millimetres"), (100, "size=|<origin xyz=", "mass of link 'palm' .*in another unit than metres"),
    (40, "size=|<origin xyz=", "inertia of link 'palm' .*in another unit than metres")])
def test_units_that_are_not_metres_are_refused(tmp_path: Path, factor: float, lengths: str, told: str) -> None:
    """Its links state no mass, so MuJoCo derives one from their shapes, which is absurd too."""
    def scaled(match: re.Match[str]) -> str:
        return match[1] + " ".join(str(float(x) * factor) for x in match[2].split()) + '"'

    text = re.sub(rf'((?:{lengths})")([^"]*)"', scaled, claw())
    with pytest.raises(HandError, match=told):
        dro.load_hand(written(tmp_path, text))


def test_fingers_that_enclose_nothing_are_refused(tmp_path: Path) -> None:
    flat = link("left", '<box size="0.012 1e-9 0.06"/>')
    text = claw(links=flat, joints=joint("a", "palm", "left", "0 0 0", "0 1 0"))
    with pytest.raises(HandError, match=r"claw\.urdf: .*enclose no space"):
        dro.load_hand(written(tmp_path, text.replace("0.08 0.08 0.02", "0.02 1e-9 0.02")))


def test_names_of_robot_descriptions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package, module = ModuleType("robot_descriptions"), ModuleType("robot_descriptions.claw_description")
    module.URDF_PATH = str(written(tmp_path, claw()))
    monkeypatch.setitem(sys.modules, "robot_descriptions", package)
    monkeypatch.setitem(sys.modules, "robot_descriptions.claw_description", module)
    for name in ("claw", "claw_description"):
        assert dro.load_hand(name).tree.n_dof == 2


def test_robot_descriptions_without_a_file_to_read_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("robot_descriptions.claw_description")
    module.XACRO_PATH = "claw.xacro"
    monkeypatch.setitem(sys.modules, "robot_descriptions", ModuleType("robot_descriptions"))
    monkeypatch.setitem(sys.modules, "robot_descriptions.claw_description", module)
    with pytest.raises(HandError, match="'claw_description' as neither URDF nor MJCF file; convert it"):
        dro.load_hand("claw")


def test_without_robot_descriptions_the_error_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "robot_descriptions", None)
    with pytest.raises(HandError, match="install `robot_descriptions`"):
        dro.load_hand("panda")


def test_fingers_that_curl_past_the_centre_open_outwards(tmp_path: Path) -> None:
    """Two fingers face one; half closed they have passed each other."""
    links = joints = ""
    for i, (x, y, axis) in enumerate(((-0.04, -0.02, "0 1 0"), (-0.04, 0.02, "0 1 0"), (0.04, 0.0, "0 -1 0"))):
        links += link(f"a{i}") + link(f"b{i}")
        joints += joint(f"j{i}", "palm", f"a{i}", f"{x} {y} 0.01", axis)
        joints += joint(f"k{i}", f"a{i}", f"b{i}", "0 0 0.06", axis, LIMIT + f'<mimic joint="j{i}" multiplier="0.6"/>')
    hand = dro.load_hand(written(tmp_path, claw(links=links, joints=joints)))
    assert hand.opening_signs.tolist() == [-1, -1, -1]
    assert float(hand.palm_direction_wrist[2]) > 0.99


def test_a_description_that_cannot_be_fetched_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str) -> ModuleType:
        raise RuntimeError(f"git fetch\n  stderr: 'could not resolve host' for {name}")

    monkeypatch.setattr("dro_grasp.hands.library.importlib.import_module", fail)
    with pytest.raises(HandError, match=r"could not fetch 'panda' .*could not resolve host.*connect to the network"):
        dro.load_hand("panda")


@pytest.mark.parametrize("n_points", [0, -1, 11, 1537, 100_000])
def test_numbers_of_points_that_a_hand_cannot_have_are_refused(tmp_path: Path, n_points: int) -> None:
    path = written(tmp_path, claw())
    with pytest.raises(OptionError, match=f"n_points is {n_points}; give an integer from 12 to 1536"):
        dro.load_hand(path, n_points=n_points)


@pytest.mark.parametrize("n_points", [12, 1536])
def test_numbers_of_points_at_both_ends_give_a_hand_with_fingertips(tmp_path: Path, n_points: int) -> None:
    hand = dro.load_hand(written(tmp_path, claw()), n_points=n_points)
    assert hand.n_points == n_points
    assert all(bool((hand.link_index == tip).any()) for tip in hand.tips)
