"""Mirrored and scaled URDFs, against the bodies that MuJoCo itself makes of the original."""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ET

import mujoco
import numpy as np
import pytest

from dro_grasp.hands.variants import mirror, scale

MIRROR = np.diag([1.0, -1.0, 1.0])
LIMIT = '<limit lower="-0.02" upper="0.9" velocity="2" effort="3"/>'
MASS = ('<inertial><origin xyz="0.01 0.02 0.03" rpy="0.1 0.2 0.3"/><mass value="0.3"/>'
        '<inertia ixx="3e-4" iyy="2e-4" izz="4e-4" ixy="2e-5" ixz="3e-5" iyz="4e-5"/></inertial>')
HAND = f"""<robot name="skew"><mujoco><compiler fusestatic="false"/></mujoco>
<link name="palm">{MASS}</link><link name="thumb">{MASS}</link><link name="tip">{MASS}</link><link name="pad">{MASS}</link>
<joint name="a" type="revolute"><parent link="palm"/><child link="thumb"/><origin xyz="0.03 0.04 0.05" rpy="0.4 -0.7 1.1"/>
{LIMIT}</joint>
<joint name="b" type="prismatic"><parent link="thumb"/><child link="tip"/><origin rpy="0 0.5 0.2"/><axis xyz="0.48 0.6 0.64"/>
{LIMIT}</joint>
<joint name="c" type="revolute"><parent link="tip"/><child link="pad"/><origin xyz="0 0.02 0.01"/><axis xyz="0 0.6 0.8"/>
<limit lower="-1" upper="1" velocity="1" effort="1"/><mimic joint="b" multiplier="30" offset="0.1"/></joint></robot>"""


def bodies(root: ET.Element, q: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray, float]]:
    """Place, rotation, inertia about the own axes in the world, and mass of each body."""
    model = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))
    data, found = mujoco.MjData(model), {}
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    for body in range(1, model.nbody):
        turn = data.ximat[body].reshape(3, 3)
        inertia = turn @ np.diag(model.body_inertia[body]) @ turn.T
        found[model.body(body).name] = (
            data.xpos[body].copy(), data.xmat[body].reshape(3, 3).copy(), inertia, float(model.body_mass[body]))
    return found


@pytest.mark.parametrize("q", [np.zeros(3), np.array([0.8, 0.3, -0.6])], ids=["zero", "bent"])
def test_every_body_is_the_mirror_image_of_the_original_one(q: np.ndarray) -> None:
    root = ET.fromstring(HAND)
    original = bodies(root, q)
    mirror(root)
    assert len(original) >= 3
    for name, (place, turn, inertia, mass) in bodies(root, q).items():
        expected = original[name]
        np.testing.assert_allclose(place, MIRROR @ expected[0], atol=1e-8)  # [m]
        np.testing.assert_allclose(turn, MIRROR @ expected[1] @ MIRROR, atol=1e-8)
        np.testing.assert_allclose(inertia, MIRROR @ expected[2] @ MIRROR, atol=1e-10)  # [kg m^2]
        assert mass == expected[3]


def test_a_scaled_hand_has_bodies_farther_apart_and_heavier_by_the_cube() -> None:
    q, factor = np.array([0.8, 0.3, -0.6]), 1.5
    root = ET.fromstring(HAND)
    original = bodies(root, q)
    scale(root, factor)
    for name, (place, turn, inertia, mass) in bodies(root, q * [1, factor, 1]).items():  # the second joint slides
        np.testing.assert_allclose(place, factor * original[name][0], atol=1e-8)
        np.testing.assert_allclose(turn, original[name][1], atol=1e-8)
        np.testing.assert_allclose(inertia, factor**5 * original[name][2], rtol=1e-6, atol=1e-12)
        assert mass == pytest.approx(factor**3 * original[name][3])
    limits = {j.get("name"): {k: float(v) for k, v in j.find("limit").attrib.items()} for j in root.findall("joint")}  # type: ignore[union-attr]
    assert limits["a"] == {"lower": -0.02, "upper": 0.9, "velocity": 2, "effort": 3}
    assert limits["b"] == pytest.approx({"lower": -0.03, "upper": 1.35, "velocity": 3, "effort": 3})
    (mimic,) = root.iter("mimic")
    leader = 0.2
    assert float(mimic.get("multiplier", "")) * factor * leader + 0.1 == pytest.approx(30 * leader + 0.1), "equal angles"
    assert mimic.get("offset") == "0.1"


def test_meshes_and_shapes_change_and_nothing_is_added_where_nothing_changes() -> None:
    shapes = ('<visual><origin rpy="0.1 0 0"/><geometry><mesh filename="a.stl"/></geometry></visual>'
              '<visual><geometry><mesh filename="b.stl" scale="1 2 3"/></geometry></visual>'
              '<collision><geometry><cylinder radius="0.1" length="0.2"/></geometry></collision>')
    root = ET.fromstring(f'<robot><link name="palm">{shapes}</link></robot>')
    before = copy.deepcopy(root)
    mirror(root)
    assert [mesh.get("scale") for mesh in root.iter("mesh")] == ["1 -1 1", "1 -2 3"]
    assert [(o.get("xyz"), o.get("rpy")) for o in root.iter("origin")] == [(None, "-0.1 0 0")], "no place is added"
    mirror(root)
    scale(root, 1.0)
    assert [mesh.get("scale") for mesh in root.iter("mesh")] == ["1 1 1", "1 2 3"]
    scale(root, 0.5)
    (cylinder,) = root.iter("cylinder")
    assert cylinder.attrib == {"radius": "0.05", "length": "0.1"}
    assert [e.tag for e in root.iter()] == [e.tag for e in before.iter()]
