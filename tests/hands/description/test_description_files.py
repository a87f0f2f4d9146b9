"""The parts of hand loading: chains of couplings, refused XML, includes, and the search for meshes."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import trimesh

from dro_grasp.errors import HandError
from dro_grasp.hands.description.compiling import read_mesh
from dro_grasp.hands.description.loader import load_description
from dro_grasp.hands.description.tree_reading import Coupling, resolve_couplings
from dro_grasp.hands.description.urdf import find_mesh, resolve_meshes
from dro_grasp.hands.description.xml_files import included_files, parse_xml
from tests.helpers.claw_urdf import claw, joint, written

NAMES = ["a", "b", "c", "d"]
HERE = Path("hand.urdf")


def test_chains_of_followers_multiply_and_shift():
    # d follows c, c follows a; b is free.
    rules = (Coupling(2, 0, 0.5, 0.1), Coupling(3, 2, -2.0, 0.3))
    free, coupling, offset = resolve_couplings(rules, NAMES, HERE)
    assert free == [0, 1]
    for a, b in np.random.default_rng(0).uniform(-1, 1, (5, 2)):
        c = 0.5 * a + 0.1
        np.testing.assert_allclose(coupling @ [a, b] + offset, [a, b, c, -2 * c + 0.3], atol=1e-12)


def test_a_held_joint_and_what_follows_it_are_constant():
    rules = (Coupling(1, -1, 1.0, 0.4), Coupling(2, 1, 3.0, 0.1))
    free, coupling, offset = resolve_couplings(rules, NAMES[:3], HERE)
    assert free == [0]
    np.testing.assert_allclose(coupling[1:], 0)
    np.testing.assert_allclose(offset, [0, 0.4, 1.3])


@pytest.mark.parametrize(("ratio", "offset", "low", "high"), [
    (0.5, 0.3, 0.1, 0.7), (-2.0, 1.0, -0.2, 0.6), (1.0, 0.0, -1.0, 3.0)])
def test_a_joint_moves_as_far_as_its_follower_stays_within_limits(
    tmp_path: Path, ratio: float, offset: float, low: float, high: float
) -> None:
    follows = (f'<limit lower="{low}" upper="{high}" effort="1" velocity="1"/>'
               f'<mimic joint="a" multiplier="{ratio}" offset="{offset}"/>')
    text = claw(joints=joint("a", "palm", "left", "0 0 0.01") + joint("b", "left", "right", "0 0 0.06", more=follows))
    tree = load_description(written(tmp_path, text)).tree
    ways = np.linspace(0, 1.5, 15_001)  # those of joint a
    kept = ways[(ratio * ways + offset >= low - 1e-9) & (ratio * ways + offset <= high + 1e-9)]
    assert (float(tree.lower), float(tree.upper)) == pytest.approx((kept.min(), kept.max()), abs=2e-4)


@pytest.mark.parametrize("rules", [(Coupling(0, 0, 1, 0),), (Coupling(0, 1, 1, 0), Coupling(1, 2, 1, 0), Coupling(2, 0, 1, 0))])
def test_followers_in_a_circle_are_refused(rules):
    with pytest.raises(HandError, match=r"in a cycle .a -> "):
        resolve_couplings(rules, NAMES[:3], HERE)


@pytest.mark.parametrize(("text", "word"), [
    ("<robot><link", "not valid XML"),
    ("", "not valid XML"),
    ('<!DOCTYPE x [<!ENTITY a "aaaa">]><robot>&a;</robot>', "declares XML entities"),
    ('<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="x"/></robot>', "xacro template; expand it"),
])
def test_files_that_only_look_like_descriptions_are_refused(tmp_path, text, word):
    path = tmp_path / "hand.urdf"
    path.write_text(text)
    with pytest.raises(HandError, match=word):
        parse_xml(path)


def test_a_folder_and_a_missing_file_are_refused(tmp_path):
    with pytest.raises(HandError, match="is a folder"):
        parse_xml(tmp_path)
    with pytest.raises(HandError, match="no hand description at"):
        parse_xml(tmp_path / "none.urdf")


def test_includes_are_found_through_others_and_once(tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "main.xml").write_text('<mujoco><include file="parts/a.xml"/><include file="parts/b.xml"/></mujoco>')
    (tmp_path / "parts" / "a.xml").write_text('<mujoco><include file="parts/b.xml"/></mujoco>')
    (tmp_path / "parts" / "b.xml").write_text("<mujoco/>")
    main = tmp_path / "main.xml"
    assert {p.name for p in included_files(parse_xml(main), main)} == {"a.xml", "b.xml"}
    (tmp_path / "parts" / "b.xml").unlink()
    with pytest.raises(HandError, match=r"includes 'parts/b\.xml', which does not exist"):
        included_files(parse_xml(main), main)


@pytest.mark.parametrize("name", ["meshes/tip.stl", "package://my_hand/meshes/tip.stl", "file://meshes/tip.stl"])
def test_meshes_are_found_under_every_spelling(tmp_path, name):
    mesh = tmp_path / "my_hand" / "meshes" / "tip.stl"
    mesh.parent.mkdir(parents=True)
    mesh.write_bytes(b"x")
    assert find_mesh(name, tmp_path / "my_hand") == mesh
    assert find_mesh(str(mesh), tmp_path) == mesh
    assert find_mesh("other.stl", tmp_path / "my_hand") is None
    assert find_mesh("", tmp_path) is None


@pytest.mark.parametrize("name", ["file://meshes/left%20tip%231.stl", "package://my%20hand/meshes/left%20tip%231.stl"])
def test_meshes_are_found_under_encoded_uris(tmp_path, name):
    mesh, literal = (tmp_path / "my hand" / "meshes" / stem for stem in ("left tip#1.stl", "left%20tip%231.stl"))
    mesh.parent.mkdir(parents=True)
    mesh.write_bytes(b"x")
    assert find_mesh(name, tmp_path / "my hand") == mesh
    assert find_mesh(f"file://{tmp_path}/my%20hand/meshes/left%20tip%231.stl", Path("/")) == mesh
    assert find_mesh("meshes/left%20tip%231.stl", tmp_path / "my hand") == mesh, "though a plain path is no URI"
    literal.write_bytes(b"x")
    assert find_mesh(name.replace("my%20hand", "my hand"), tmp_path / "my hand") == literal, "the very name comes first"


def test_a_mesh_beside_the_packages_folder_is_found(tmp_path):
    mesh = tmp_path / "my_hand" / "meshes" / "tip.stl"
    mesh.parent.mkdir(parents=True)
    mesh.write_bytes(b"x")
    (tmp_path / "my_hand" / "urdf").mkdir()
    assert find_mesh("package://my_hand/meshes/tip.stl", tmp_path / "my_hand" / "urdf") == mesh


def test_lost_collision_meshes_give_way_to_visual_shapes(tmp_path):
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "box.ply")
    root = ET.fromstring(
        '<robot><link name="l"><visual><geometry><mesh filename="box.ply"/></geometry></visual>'
        '<collision><geometry><mesh filename="lost.stl"/></geometry></collision></link></robot>')
    notes: list = []
    files, converted = resolve_meshes(root, tmp_path / "hand.urdf", notes)
    assert [f.name for f in files] == ["box.ply"]
    (stand_in,) = converted
    assert stand_in.endswith(".obj")
    assert root.find("link/collision/geometry/mesh").get("filename") == stand_in
    assert ["was not found" in n.text or "visual shapes" in n.text for n in notes] == [True, True]
    assert read_mesh(tmp_path / "box.ply", []).volume == pytest.approx(1e-3)


def test_a_mesh_in_no_known_format_is_refused(tmp_path):
    (tmp_path / "bad.glb").write_bytes(b"nonsense")
    with pytest.raises(HandError, match=r"bad\.glb cannot be read"):
        read_mesh(tmp_path / "bad.glb", [])
