"""Descriptions that are wrong, told in words; odd ones that must work; and what `hand check` says of them."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch
import trimesh

import dro_grasp as dro
from dro_grasp.errors import HandError
from dro_grasp.hands.check import check_hand, hand_side, picture

PALM = '<link name="palm"><visual><geometry><box size="0.08 0.08 0.02"/></geometry></visual>' \
       '<collision><geometry><box size="0.08 0.08 0.02"/></geometry></collision></link>'
LIMIT = '<limit lower="0" upper="1.5" effort="1" velocity="1"/>'


def link(name: str, geometry: str = '<box size="0.012 0.012 0.06"/>', kinds: tuple[str, ...] = ("visual", "collision")) -> str:
    """A link whose shape begins at its joint."""
    shape = f'<origin xyz="0 0 0.03"/><geometry>{geometry}</geometry>'
    return f'<link name="{name}">' + "".join(f"<{kind}>{shape}</{kind}>" for kind in kinds) + "</link>"


def joint(
    name: str, parent: str, child: str, at: str, axis: str = "0 1 0", more: str = LIMIT, kind: str = "revolute"
) -> str:
    """A joint of a URDF."""
    return (f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/>'
            f'<axis xyz="{axis}"/>{more}</joint>')


def claw(inside: str = "", *, links: str = "", joints: str = "") -> str:
    """Two facing fingers on a palm; parts may be replaced."""
    links = links or link("left") + link("right")
    joints = joints or joint("a", "palm", "left", "-0.035 0 0.01") + joint("b", "palm", "right", "0.035 0 0.01", "0 -1 0")
    return f'<robot name="claw">{PALM}{links}{joints}{inside}</robot>'


def written(folder: Path, text: str, name: str = "claw.urdf") -> Path:
    """The text as a file."""
    path = folder / name
    path.write_text(text)
    return path


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
         "</mujoco>", "ball joint"),
        ('<mujoco><asset><mesh name="m" file="m.stl"/></asset><worldbody><body><joint/><geom type="mesh" mesh="m"/></body>'
         "</worldbody></mujoco>", "m.stl"),
        ('<mujoco><worldbody><body><hinge/></body></worldbody></mujoco>', "hinge"),
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


def test_an_unknown_name_names_near_ones() -> None:
    with pytest.raises(HandError, match=r"Perhaps you meant.*allegro"):
        dro.load_hand("alegro")


def meshed(name: str) -> str:
    """A claw whose left finger is a mesh."""
    return claw(links=link("left", f'<mesh filename="{name}"/>') + link("right"))


@pytest.mark.parametrize("name", ["../meshes/finger.stl", "package://my_hand/meshes/finger.stl", "file://{folder}/meshes/finger.stl"])
def test_meshes_are_found_where_descriptions_put_them(tmp_path: Path, name: str) -> None:
    for folder in ("urdf", "meshes"):
        (tmp_path / "my_hand" / folder).mkdir(parents=True)
    trimesh.creation.box((0.012, 0.02, 0.06)).export(tmp_path / "my_hand" / "meshes" / "finger.stl")
    path = written(tmp_path / "my_hand" / "urdf", meshed(name.format(folder=tmp_path / "my_hand")))
    hand = dro.load_hand(path)
    finger = hand.link_points[hand.link_index == hand.tree.link_names.index("left")]
    torch.testing.assert_close(finger.abs().amax(0)[:2], torch.tensor([0.006, 0.01]), atol=2e-4, rtol=0)


def test_a_lost_mesh_is_named_and_the_rest_is_used(tmp_path: Path) -> None:
    report = check_hand(written(tmp_path, meshed("package://x/lost.stl")))
    assert any(n.subject == "left" and "'package://x/lost.stl' was not found" in n.text for n in report.notes)


def test_a_hand_of_lost_meshes_only_is_refused(tmp_path: Path) -> None:
    text = claw(links=link("left", '<mesh filename="l.stl"/>') + link("right", '<mesh filename="r.stl"/>'))
    text = text.replace('<box size="0.08 0.08 0.02"/>', '<mesh filename="p.stl"/>')
    with pytest.raises(HandError, match=r"none of its 6 meshes can be found .*looked for .*p\.stl"):
        dro.load_hand(written(tmp_path, text))


def test_a_broken_mesh_is_named(tmp_path: Path) -> None:
    (tmp_path / "finger.stl").write_text("solid nothing")
    with pytest.raises(HandError, match=r"finger\.stl"):
        dro.load_hand(written(tmp_path, meshed("finger.stl")))


def notes(folder: Path, text: str) -> dict[str, str]:
    """What `hand check` finds, by link or joint."""
    return {note.subject: note.text for note in check_hand(written(folder, text)).notes}


def test_check_names_free_coupled_and_unlimited_joints(tmp_path: Path) -> None:
    tip = link("tip")
    joints = (joint("a", "palm", "left", "-0.035 0 0.01", kind="continuous", more="")
              + joint("b", "palm", "right", "0.035 0 0.01", "0 -1 0")
              + joint("c", "right", "tip", "0 0 0.06", "0 -1 0", LIMIT + '<mimic joint="b" multiplier="0.5" offset="0.1"/>'))
    text = claw(links=link("left") + link("right") + tip, joints=joints)
    report = check_hand(written(tmp_path, text))
    assert report.facts["free_joints"] == ["a", "b"]
    assert report.facts["coupled_joints"] == ["c = 0.5 * b + 0.1"]
    assert "no limits" in notes(tmp_path, text)["a"]
    assert any("free joints" in line and "a, b" in line for line in report.lines())


def test_check_names_a_mimic_of_nothing(tmp_path: Path) -> None:
    text = claw(joints=joint("a", "palm", "left", "-0.035 0 0.01", more=LIMIT + '<mimic joint="ghost"/>')
                + joint("b", "palm", "right", "0.035 0 0.01", "0 -1 0"))
    assert "'ghost'" in notes(tmp_path, text)["a"]


def test_check_names_links_that_cannot_collide_or_have_no_volume(tmp_path: Path) -> None:
    assert "cannot touch" in notes(tmp_path, claw(links=link("left", kinds=("visual",)) + link("right")))["left"]
    corners = [[0, 0, 0], [0, 0, 0.06], [0, 0.02, 0.0], [0, 0.02, 0.06]]
    trimesh.Trimesh(corners, [[0, 1, 2], [1, 3, 2]], process=False).export(tmp_path / "flat.stl")
    assert "without volume" in notes(tmp_path, meshed("flat.stl"))["left"]
    trimesh.Trimesh(corners[:3], [[0, 1, 2]], process=False).export(tmp_path / "flat.stl")
    assert "fewer than 4 vertices" in notes(tmp_path, meshed("flat.stl"))["flat"]


@pytest.mark.parametrize(("factor", "told"), [(1000, "looks like millimetres"), (0.1, "another unit")])
def test_units_that_are_not_metres_are_refused(tmp_path: Path, factor: float, told: str) -> None:
    def scaled(match: re.Match[str]) -> str:
        return match[1] + " ".join(str(float(x) * factor) for x in match[2].split()) + '"'

    text = re.sub(r'((?:size=|<origin xyz=)")([^"]*)"', scaled, claw())
    with pytest.raises(HandError, match=told):
        check_hand(written(tmp_path, text))


def test_fingers_that_enclose_nothing_are_refused(tmp_path: Path) -> None:
    flat = link("left", '<box size="0.012 1e-9 0.06"/>')
    text = claw(links=flat, joints=joint("a", "palm", "left", "0 0 0", "0 1 0"))
    with pytest.raises(HandError, match="enclose no space"):
        dro.load_hand(written(tmp_path, text.replace("0.08 0.08 0.02", "0.02 1e-9 0.02")))


def three_fingers_and_thumb(side: float) -> str:
    """Fingers up along z, palm towards x, thumb at +y or -y: a right hand has it at +y."""
    links, joints = "", ""
    for i in range(3):
        links += link(f"f{i}")
        joints += joint(f"j{i}", "palm", f"f{i}", f"0 {0.03 * (i - 1)} 0.05")
    links += link("thumb")
    joints += joint("jt", "palm", "thumb", f"0.02 {side * 0.07} -0.02")
    palm = PALM.replace("0.08 0.08 0.02", "0.02 0.09 0.1")
    return f'<robot name="h">{palm}{links}{joints}</robot>'


@pytest.mark.parametrize(("side", "name"), [(1.0, "right"), (-1.0, "left")])
def test_sides_of_mirrored_hands(tmp_path: Path, side: float, name: str) -> None:
    assert hand_side(dro.load_hand(written(tmp_path, three_fingers_and_thumb(side)))) == name


@pytest.mark.assets
@pytest.mark.parametrize(
    ("name", "side"),
    [("allegro_left", "left"), ("allegro_right", "right"), ("shadowhand", "right"), ("leaphand", "right"),
     ("inspire", "right"), ("ability", "right"), ("orca", "right"), ("barrett", "none")],
)
def test_sides_of_real_hands(assets_folder: Path, name: str, side: str) -> None:
    assert hand_side(dro.load_hand(f"assets/{name}")) == side


def test_the_picture_shows_the_hand_open_and_closed(tmp_path: Path) -> None:
    from PIL import Image

    picture(dro.load_hand(written(tmp_path, claw())), tmp_path / "claw.png")
    with Image.open(tmp_path / "claw.png") as sheet:
        opened, closed = (sheet.crop((x, 30, x + sheet.width // 2, sheet.height - 30)) for x in (0, sheet.width // 2))
        assert opened.tobytes() != closed.tobytes()
        colours = {colour for _, colour in sheet.convert("RGB").getcolors(1 << 24)}
    assert any(r > 150 and g < 60 and b < 60 for r, g, b in colours), "no red arrow"
    assert any(b > 150 and r < 80 and g < 120 for r, g, b in colours), "no blue track"


def test_names_of_robot_descriptions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package, module = ModuleType("robot_descriptions"), ModuleType("robot_descriptions.claw_description")
    module.URDF_PATH = str(written(tmp_path, claw()))
    monkeypatch.setitem(sys.modules, "robot_descriptions", package)
    monkeypatch.setitem(sys.modules, "robot_descriptions.claw_description", module)
    for name in ("claw", "claw_description"):
        assert dro.load_hand(name).tree.n_dof == 2


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
    assert hand.opening.tolist() == [-1, -1, -1]
    assert float(hand.palm_direction_wrist[2]) > 0.99
