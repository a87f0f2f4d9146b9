"""Mirrored and scaled hands, against mirrored and scaled kinematics, shapes and masses of the original."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import trimesh

import dro_grasp as dro
from dro_grasp.cli.main import main
from dro_grasp.errors import HandError, OptionError
from dro_grasp.geometry.point_clouds import enclosed_volume
from dro_grasp.hands.check import hand_side
from dro_grasp.hands.description.loader import Description, load_description
from dro_grasp.hands.library import load_hand_description
from tests.helpers.claw_urdf import LIMIT, claw, joint, link, written
from tests.helpers.loaded_hands import loaded_hand

MIRROR = np.diag([1.0, -1.0, 1.0])
HANDS = ["allegro", "barrett", "leaphand", "shadowhand", "mixed"]


def mixed_claw(folder: Path) -> Path:
    """A claw with a skewed mesh, a slide, followers across kinds, and a joint without an axis."""
    corners = np.array([[0, 0, 0], [0.01, 0, 0.01], [0, 0.02, 0.01], [0.003, 0.004, 0.06]])
    trimesh.Trimesh(corners, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], process=False).export(folder / "skew.stl")
    slide = '<limit lower="-0.01" upper="0.03"/>'
    joints = (joint("a", "palm", "left", "-0.035 0.01 0.01", more=LIMIT).replace('<axis xyz="0 1 0"/>', "")
              + joint("b", "palm", "right", "0.035 0 0.01", "0 -1 0")
              + joint("c", "right", "nail", "0 0.01 0.06", "0.6 0.8 0", slide, "prismatic")
              + joint("d", "nail", "tip", "0 0 0.02", "1 0 0", LIMIT + '<mimic joint="c" multiplier="30" offset="0.1"/>')
              + joint("e", "left", "pad", "0 0 0.06", "0 1 0", slide + '<mimic joint="b" multiplier="0.01" offset="0.002"/>',
                      "prismatic"))
    links = (link("left", '<mesh filename="skew.stl" scale="1 2 1"/>') + link("right") + link("nail") + link("tip")
             + link("pad", '<cylinder radius="0.01" length="0.03"/>'))
    heavy = ('<link name="palm"><inertial><origin xyz="0.01 0.02 0.03" rpy="0.1 0.2 0.3"/><mass value="0.3"/>'
             '<inertia ixx="3e-4" iyy="2e-4" izz="4e-4" ixy="2e-5" ixz="3e-5" iyz="4e-5"/></inertial>')
    return written(folder, claw(links=links, joints=joints).replace('<link name="palm">', heavy), "mixed.urdf")


@pytest.fixture(params=HANDS)
def source(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return str(mixed_claw(tmp_path)) if request.param == "mixed" else request.param


def pair(source: str, folder: Path, **changes: float) -> tuple[Description, Description]:
    """A hand and its variant."""
    changed = written(folder, dro.vary_hand(source, **changes), "variant.urdf")
    return load_hand_description(source)[0], load_description(changed)


def postures(description: Description) -> torch.Tensor:
    tree = description.tree
    share = torch.rand(8, tree.n_dof, generator=torch.Generator().manual_seed(0))
    return tree.lower + share * (tree.upper - tree.lower)


def inertia(description: Description) -> np.ndarray:
    """Inertias of all bodies in their link frames (n 3 3) [kg m^2]."""
    model, turns = description.model, []
    for quaternion in model.body_iquat[1:]:
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, quaternion)
        turns.append(turn.reshape(3, 3))
    return np.stack([turn @ np.diag(i) @ turn.T for turn, i in zip(turns, model.body_inertia[1:], strict=True)])


def test_equal_joints_give_mirrored_poses(source: str, tmp_path: Path) -> None:
    this, other = pair(source, tmp_path, mirrored=True)
    q, mirror = postures(this), torch.diag(torch.tensor([1.0, -1.0, 1.0, 1.0]))
    torch.testing.assert_close(other.tree.lower, this.tree.lower)
    torch.testing.assert_close(other.tree.forward(q), mirror @ this.tree.forward(q) @ mirror, atol=2e-6, rtol=0)


def test_shapes_and_inertias_are_mirrored(source: str, tmp_path: Path) -> None:
    this, other = pair(source, tmp_path, mirrored=True)
    assert len(other.geometry) == len(this.geometry)
    for a, b in zip(this.geometry, other.geometry, strict=True):
        volume = enclosed_volume(b.vertices[b.faces])
        assert volume == pytest.approx(enclosed_volume(a.vertices[a.faces]), rel=1e-5)
        assert volume > 0, "faces point outwards"
        # Tessellated cylinders and spheres need not be symmetric, so their moments are compared, not their corners.
        mesh, mirrored = (trimesh.Trimesh(g.vertices, g.faces, process=False) for g in (a, b))
        assert mirrored.center_mass == pytest.approx(MIRROR @ mesh.center_mass, abs=1e-6)
        expected = MIRROR @ mesh.moment_inertia @ MIRROR
        assert mirrored.moment_inertia == pytest.approx(expected, abs=2e-3 * np.abs(expected).max())
    assert other.masses == pytest.approx(this.masses)
    expected = MIRROR @ inertia(this) @ MIRROR
    assert inertia(other) == pytest.approx(expected, rel=1e-3, abs=1e-9)


def test_two_mirrors_give_the_hand_again(source: str, tmp_path: Path) -> None:
    once = written(tmp_path, dro.vary_hand(source, mirrored=True), "once.urdf")
    this, twice = pair(str(once), tmp_path, mirrored=True)[1], load_hand_description(source)[0]
    q = postures(this)
    torch.testing.assert_close(this.tree.forward(q), twice.tree.forward(q), atol=2e-6, rtol=0)


def test_scaled_hands_have_scaled_positions_masses_and_slides(source: str, tmp_path: Path) -> None:
    this, other = pair(source, tmp_path, factor=1.3)
    slides = torch.tensor([name == "c" for name in this.tree.joint_names])
    q = postures(this)
    larger = torch.where(slides, 1.3 * q, q)
    torch.testing.assert_close(other.tree.upper, torch.where(slides, 1.3 * this.tree.upper, this.tree.upper))
    before, after = this.tree.forward(q), other.tree.forward(larger)
    torch.testing.assert_close(after[..., :3, 3], 1.3 * before[..., :3, 3], atol=2e-6, rtol=0)
    torch.testing.assert_close(after[..., :3, :3], before[..., :3, :3], atol=2e-6, rtol=0)
    stated = [body for body in range(1, this.model.nbody) if this.model.body_mass[body] > 2e-4]
    assert other.model.body_mass[stated] == pytest.approx(1.3**3 * this.model.body_mass[stated], rel=1e-5)
    for a, b in zip(this.geometry, other.geometry, strict=True):
        assert b.vertices == pytest.approx(1.3 * a.vertices, abs=1e-6)


def test_a_right_hand_becomes_a_left_one(tmp_path: Path) -> None:
    assert hand_side(loaded_hand("leaphand")) == "right"
    assert main(["hand", "vary", "leaphand", "--mirrored", "--scale", "0.8", "--output", str(tmp_path / "left.urdf")]) == 0
    left = dro.load_hand(tmp_path / "left.urdf")
    assert hand_side(left) == "left"
    size = [np.ptp(hand.points(hand.canonical_joints()).numpy(), axis=0).max() for hand in (left, loaded_hand("leaphand"))]
    assert size[0] == pytest.approx(0.8 * size[1], rel=0.05)


def test_what_cannot_be_varied_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(OptionError, match=r"factor is 0\.0"):
        dro.vary_hand("leaphand", factor=0.0)
    mjcf = written(tmp_path, "<mujoco/>", "hand.xml")
    with pytest.raises(HandError, match="only a URDF"):
        dro.vary_hand(mjcf, mirrored=True)
    assert main(["hand", "vary", "leaphand", "--output", str(tmp_path / "same.urdf")]) == 2
    assert "--mirrored" in capsys.readouterr().err


def test_meshes_beside_what_a_link_leads_to_are_found(tmp_path: Path) -> None:
    (tmp_path / "a" / "meshes").mkdir(parents=True)
    (tmp_path / "b").mkdir()
    trimesh.creation.box((0.02, 0.02, 0.02)).export(tmp_path / "a" / "meshes" / "x.stl")
    root = ET.fromstring((Path(dro.__file__).parent / "hands" / "builtin" / "gripper3.urdf").read_text())
    for geometry in root.iter("geometry"):
        for shape in list(geometry):
            geometry.remove(shape)
        ET.SubElement(geometry, "mesh", filename="meshes/x.stl")
    ET.ElementTree(root).write(tmp_path / "a" / "h.urdf")
    (tmp_path / "b" / "h.urdf").symlink_to(tmp_path / "a" / "h.urdf")
    made = ET.fromstring(dro.vary_hand(str(tmp_path / "b" / "h.urdf"), factor=1.2))
    assert {mesh.get("filename") for mesh in made.iter("mesh")} == {str(tmp_path / "a" / "meshes" / "x.stl")}
