"""Meshes of links whose files state a unit. Oracle: the same box written in metres."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

from dro_grasp.errors import HandError
from dro_grasp.hands.check import check_hand
from dro_grasp.hands.description.loader import load_description
from dro_grasp.hands.library import load_hand
from tests.helpers.claw_urdf import claw, link, meshed, written

SIZE = (0.012, 0.012, 0.06)  # of a finger [m]


def collada(folder: Path, unit: float, stated: str, name: str = "tip.dae") -> None:
    """A finger's box as COLLADA, in some unit."""
    text = trimesh.exchange.dae.export_collada(trimesh.creation.box(np.divide(SIZE, unit))).decode()
    head, rest = text.split("<asset>")
    asset = rest.index("</asset>")
    kept = "".join(part for part in rest[:asset].splitlines(True) if "<unit" not in part)
    (folder / name).write_text(f"{head}<asset>{kept}{stated}{rest[asset:]}")


def size_of_left(path: Path) -> list[float]:
    description = load_description(path)
    left = description.tree.link_names.index("left")
    (shape,) = (g for g in description.geometry if g.link == left and g.collides)
    return np.ptp(shape.vertices, axis=0).tolist()


@pytest.mark.parametrize(("unit", "stated"), [
    (0.0254, '<unit meter="0.0254" name="inch"/>'), (0.01, '<unit meter="0.01"/>'), (0.001, '<unit name="mm" meter="1e-3"/>'),
    (1.0, '<unit meter="1" name="meter"/>'), (1.0, "")])
def test_the_unit_of_a_collada_file_is_honoured(tmp_path: Path, unit: float, stated: str) -> None:
    collada(tmp_path, unit, stated)
    path = written(tmp_path, meshed("tip.dae"))
    assert size_of_left(path) == pytest.approx(SIZE, rel=1e-5)
    told = [note.text for note in load_description(path).notes if note.subject == "tip.dae"]
    assert [f"{unit:g} m" in text for text in told] == ([] if unit == 1 else [True])
    assert load_hand(path).tips


def test_a_scale_counts_beside_the_unit(tmp_path: Path) -> None:
    """As in RViz and Gazebo: a file in decimetres that states centimetres needs a scale of ten."""
    collada(tmp_path, 0.1, '<unit meter="0.01"/>')
    mesh = '<mesh filename="tip.dae" scale="10 10 10"/>'
    assert size_of_left(written(tmp_path, claw(links=link("left", mesh) + link("right")))) == pytest.approx(SIZE, rel=1e-5)


def test_one_file_of_several_links_is_noted_once(tmp_path: Path) -> None:
    collada(tmp_path, 0.01, '<unit meter="0.01"/>')
    mesh = '<mesh filename="{}tip.dae"/>'
    text = claw(links=link("left", mesh.format("")) + link("right", mesh.format("./")))
    assert [note.subject for note in check_hand(written(tmp_path, text)).notes if "its unit" in note.text] == ["tip.dae"]


def test_other_formats_that_state_a_unit_are_honoured(tmp_path: Path) -> None:
    """3MF, in millimetres unless it says otherwise."""
    box = trimesh.creation.box(np.multiply(SIZE, 1000))
    vertices = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in box.vertices)
    faces = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in box.faces)
    model = ('<model unit="millimeter" xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"><resources>'
             f'<object id="1" type="model"><mesh><vertices>{vertices}</vertices><triangles>{faces}</triangles></mesh></object>'
             '</resources><build><item objectid="1"/></build></model>')
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("3D/3dmodel.model", model)
    (tmp_path / "tip.3mf").write_bytes(content.getvalue())
    assert size_of_left(written(tmp_path, meshed("tip.3mf"))) == pytest.approx(SIZE, rel=1e-5)


def box_of(folder: Path, name: str, unit: float) -> str:
    """A finger's box in some unit as STL; the element that names it."""
    trimesh.creation.box(np.divide(SIZE, unit)).export(folder / name)
    return f'<mesh filename="{name}"/>'


@pytest.mark.parametrize("unit", [0.001, 0.0001])
def test_collision_meshes_in_millimetres_beside_visual_ones_in_metres_are_left_out(tmp_path: Path, unit: float) -> None:
    large, small = box_of(tmp_path, "large.stl", unit), box_of(tmp_path, "small.stl", 1.0)
    drawn = link("left", small, ("visual",)).replace("</link>", "") + link("left", large, ("collision",)).split(">", 1)[1]
    path = written(tmp_path, claw(links=drawn + link("right")))
    assert size_of_left(path) == pytest.approx(SIZE, rel=1e-5)
    told = [note.text for note in load_description(path).notes if note.subject == "left"]
    assert len(told) == 1
    assert told[0].startswith(f"meshes of up to {0.06 / unit:.0f} m, perhaps in millimetres, are left out, and other shapes")


def test_meshes_in_millimetres_alone_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path, claw(links=link("left", box_of(tmp_path, "large.stl", 0.001)) + link("right")))
    with pytest.raises(HandError, match=r'of mesh .* looks like millimetres: state scale="0\.001 0\.001 0\.001" where'):
        load_description(path)


def test_meshes_in_centimetres_alone_are_refused(tmp_path: Path) -> None:
    mass = '<inertial><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>'
    large = link("left", box_of(tmp_path, "large.stl", 0.01)).replace("</link>", f"{mass}</link>")
    with pytest.raises(HandError, match=r'looks like centimetres; .* meshes by scale="0\.01 0\.01 0\.01" in <mesh>'):
        load_hand(written(tmp_path, claw(links=large + link("right"))))
