"""Masses decide nothing about a hand's grasps: what is wrong with them is repaired and told. Oracle: boxes of known size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from dro_grasp.hands.description.loader import Description, load_description
from dro_grasp.hands.library import load_hand
from tests.helpers.claw_urdf import claw, link, written

BOX = (0.012, 0.012, 0.06)  # of each finger [m]
OF_BOX = 1000 * float(np.prod(BOX))  # its mass, in water's density [kg]
WIDTHS = np.square(BOX)
MOMENTS = OF_BOX / 12 * np.sort(WIDTHS.sum() - WIDTHS)[::-1]
RIGHT = '<inertia ixx="1e-5" ixy="0" ixz="0" iyy="1e-5" iyz="0" izz="1e-5"/>'
MASS = '<mass value="0.1"/>'
SIDES = '<inertia ixx="1e-5" ixy="0" ixz="0" iyy="1e-5" iyz="0" izz="9e-5"/>'


def urdf(folder: Path, inertial: str) -> Path:
    """A claw whose left finger has an inertial."""
    return written(folder, claw(links=link("left").replace("<visual>", f"{inertial}<visual>") + link("right")))


def mjcf(folder: Path, inertial: str, before: str = "") -> Path:
    """The same as an MJCF."""
    box = "<geom type='box' size='.006 .006 .03' pos='0 0 .03'/>"
    return written(folder, f"""<mujoco><compiler angle="radian"/>{before}<worldbody><body name="palm">
      <geom type="box" size=".04 .04 .01"/>
      <body name="left" pos="-.035 0 .01">{inertial}<joint name="a" axis="0 1 0" range="0 1.5"/>{box}</body>
      <body name="right" pos=".035 0 .01"><joint name="b" axis="0 -1 0" range="0 1.5"/>{box}</body>
      </body></worldbody></mujoco>""", "claw.xml")


def of_left(description: Description) -> tuple[float, list[float], list[str]]:
    """Mass and moments of the left finger, and what is told about it."""
    body, told = description.model.body("left"), [note.text for note in description.notes if note.subject == "left"]
    return float(body.mass[0]), np.sort(body.inertia)[::-1].tolist(), told


def is_box(description: Description, word: str) -> None:
    """The left finger weighs what its box does, and one note says why."""
    mass, moments, told = of_left(description)
    assert mass == pytest.approx(OF_BOX)
    assert moments == pytest.approx(MOMENTS.tolist())
    assert [word in text for text in told] == [True], told


@pytest.mark.parametrize(("inertial", "word"), [
    (MASS, "states no inertia"), ('<origin xyz="0 0 0.03"/>' + MASS, "states no inertia"), (RIGHT, "states no mass"),
    ("", "states no mass"), ("<mass/>" + RIGHT, "states no mass"), ('<mass value="0"/>' + RIGHT, "not above zero"),
    ('<mass value="0"/>' + RIGHT.replace("1e-5", "0"), "not above zero"), ('<mass value="light"/>' + RIGHT, "no number"),
    ('<mass value="nan"/>' + RIGHT, "no number"), ('<mass value="inf"/>' + RIGHT, "no number"),
    (MASS + RIGHT.replace('ixy="0"', 'ixy="2e-5"'), "negative eigenvalue"),
    (MASS + RIGHT.replace('ixx="1e-5"', 'ixx="-1e-5"'), "negative eigenvalue"),
    (MASS + '<inertia ixx="1e-5" iyy="1e-5"/>', "incomplete"), (MASS + RIGHT.replace("1e-5", "nan"), "incomplete"),
    ('<origin xyz="0 0"/>' + MASS + RIGHT, "incomplete"), ('<mass value="50"/>' + RIGHT, "in gold"),
    (MASS + RIGHT.replace("1e-5", "12"), "an inertia of 12 kg m^2")])
def test_a_urdf_with_a_wrong_inertial_is_read(tmp_path: Path, inertial: str, word: str) -> None:
    is_box(load_description(urdf(tmp_path, f"<inertial>{inertial}</inertial>")), word)


def test_several_inertials_of_a_link_are_none(tmp_path: Path) -> None:
    is_box(load_description(urdf(tmp_path, 2 * f"<inertial>{MASS}{RIGHT}</inertial>")), "there are several")


@pytest.mark.parametrize(("stated", "word"), [
    ("pos='0 0 0' diaginertia='1e-5 1e-5 1e-5'", "states no mass"), ("mass='.1' diaginertia='1e-5 1e-5 1e-5'", "states no pos"),
    ("pos='0 0 0' mass='.1'", "not above zero"), ("pos='0 0 0' mass='0' diaginertia='1e-5 1e-5 1e-5'", "not above zero"),
    ("pos='0 0 0' mass='.1' diaginertia='-1e-5 1e-5 1e-5'", "not above zero"),
    ("pos='0 0 0' mass='.1' fullinertia='1e-5 1e-5 1e-5 2e-5 0 0'", "negative eigenvalue"),
    ("pos='0 0 0' mass='.1' fullinertia='1e-5 1e-5 1e-5 0 0 0' diaginertia='1e-5 1e-5 1e-5'", "two inertias"),
    ("pos='0 0 0' mass='nan' diaginertia='1e-5 1e-5 1e-5'", "incomplete"), ("pos='0 0' mass='.1'", "incomplete"),
    ("pos='0 0 0' mass='50' diaginertia='1e-5 1e-5 1e-5'", "in gold")])
def test_an_mjcf_with_a_wrong_inertial_is_read(tmp_path: Path, stated: str, word: str) -> None:
    is_box(load_description(mjcf(tmp_path, f"<inertial {stated}/>")), word)


def test_a_wrong_inertial_of_an_included_file_is_mended_and_meshes_are_found(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    tetrahedron = "".join(f"v {x}\n" for x in ("0 0 0", ".01 0 0", "0 .01 0", "0 0 .01"))
    tetrahedron += "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    written(tmp_path / "parts", tetrahedron, "nail.obj")
    written(tmp_path / "parts", "<mujoco><compiler meshdir='meshes'/><asset><mesh name='nail' file='nail.obj'/></asset>"
            "<worldbody><body name='more'><inertial mass='1' diaginertia='1 1 1'/><joint range='0 1'/><geom type='mesh' "
            "mesh='nail'/></body></worldbody></mujoco>", "more.xml")
    description = load_description(mjcf(tmp_path, "<inertial pos='0 0 0'/>", '<include file="parts/more.xml"/>'))
    is_box(description, "states no mass")
    assert "more" in {note.subject for note in description.notes if "states no pos" in note.text}


@pytest.mark.parametrize("heavy", ['<mass value="5.2"/>', '<mass value="0.3"/>'])
def test_what_a_link_may_weigh_is_kept(tmp_path: Path, heavy: str) -> None:
    """A forearm of 5.2 kg in three litres, and a finger that a motor makes heavy."""
    large = link("left", '<box size="0.1 0.1 0.3"/>') if "5.2" in heavy else link("left")
    text = claw(links=large.replace("<visual>", f"<inertial>{heavy}{RIGHT}</inertial><visual>") + link("right"))
    mass, _, told = of_left(load_description(written(tmp_path, text)))
    assert mass == pytest.approx(float(heavy.split('"')[1]))
    assert not told


def test_inertias_that_no_body_has_are_balanced_and_told(tmp_path: Path) -> None:
    mass, moments, told = of_left(load_description(urdf(tmp_path, f"<inertial>{MASS}{SIDES}</inertial>")))
    assert mass == pytest.approx(0.1)
    assert moments == pytest.approx([11e-5 / 3] * 3)
    assert [("balanced" in text) for text in told] == [True]


def test_frames_without_mass_are_no_finding(tmp_path: Path) -> None:
    frame = '<link name="frame"><inertial><mass value="0"/>' + RIGHT.replace("1e-5", "0") + "</inertial></link>"
    fixed = '<joint name="at" type="fixed"><parent link="left"/><child link="frame"/></joint>'
    assert not load_description(written(tmp_path, claw(frame + fixed))).notes


def test_a_hand_is_the_same_whatever_its_masses(tmp_path: Path) -> None:
    plain, wrong = (load_hand(urdf(tmp_path, inertial)) for inertial in ("", "<inertial><mass value='50'/></inertial>"))
    assert torch.equal(plain.link_points, wrong.link_points)
    assert torch.equal(plain.palm_direction, wrong.palm_direction)
