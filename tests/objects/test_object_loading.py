from __future__ import annotations

import json
import os
import struct
import zipfile
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest
import trimesh

from dro_grasp.errors import ObjectError
from dro_grasp.geometry import mesh_files
from dro_grasp.objects.loading import load_file
from tests.helpers.saddle import saddle


def save(mesh: trimesh.Trimesh, path: Path) -> Path:
    mesh.export(path)
    return path


def sphere(radius: float = 0.03, at: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(3, radius)
    mesh.apply_translation(at)
    return mesh


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "off", "glb", "gltf", "dae", "3mf"])
def test_every_format_gives_the_same_object(tmp_path: Path, suffix: str):
    mesh = trimesh.creation.box((0.04, 0.05, 0.06))
    mesh.visual = trimesh.visual.ColorVisuals(mesh)
    path = tmp_path / f"thing.{suffix}"
    if suffix == "3mf":  # states millimetres
        mesh.apply_scale(1000)
    if suffix == "gltf":
        for name, data in trimesh.Scene(mesh).export(file_type="gltf").items():
            (tmp_path / ("thing.gltf" if name == "model.gltf" else name)).write_bytes(data)
    else:
        mesh.export(path)
    obj = load_file(path)
    assert obj.name == "thing"
    assert obj.split is None
    np.testing.assert_allclose(np.sort(obj.extents), (0.04, 0.05, 0.06), atol=1e-6)
    assert obj.volume == pytest.approx(1.2e-4, rel=1e-4)
    assert obj.notes == ()


def test_scene_is_merged_with_its_transforms(tmp_path: Path):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box((0.02, 0.02, 0.02)))
    scene.add_geometry(
        trimesh.creation.box((0.02, 0.02, 0.02)), transform=trimesh.transformations.translation_matrix((0.05, 0, 0)))
    scene.export(tmp_path / "two.glb")
    obj = load_file(tmp_path / "two.glb")
    assert obj.volume == pytest.approx(2 * 8e-6, rel=1e-4)
    assert obj.extents[0] == pytest.approx(0.07, abs=1e-6)
    (told,) = obj.notes
    assert told.startswith("2 separate bodies, up to 3 cm apart, count as one rigid object")


def gltf(folder: Path, name: str = "data.bin") -> tuple[Path, dict[str, Any]]:
    """A box as a glTF beside its numbers, which lie in a file of this name; the path, and what it says."""
    parts = trimesh.Scene(trimesh.creation.box((0.04, 0.05, 0.06))).export(file_type="gltf", merge_buffers=True)
    content = json.loads(parts.pop("model.gltf"))
    (data,) = parts.values()
    (folder / unquote(name)).write_bytes(data)
    content["buffers"][0]["uri"] = name
    (folder / "box.gltf").write_text(json.dumps(content))
    return folder / "box.gltf", content


@pytest.mark.parametrize("name", ["data.bin", "my%20data.bin", "100%25.bin"])
def test_buffers_of_a_gltf_may_have_names_with_percent_signs(tmp_path: Path, name: str) -> None:
    assert load_file(gltf(tmp_path, name)[0]).volume == pytest.approx(1.2e-4, rel=1e-4)


@pytest.mark.parametrize("name", ["../secret.bin", "%2e%2e/secret.bin", "..%2Fsecret.bin"])
def test_buffers_of_a_gltf_lie_beside_it(tmp_path: Path, name: str) -> None:
    (tmp_path / "own").mkdir()
    path, _ = gltf(tmp_path / "own", name)
    assert (tmp_path / "secret.bin").is_file()
    with pytest.raises(ObjectError, match="there is no such file beside it"):
        load_file(path)


@pytest.mark.parametrize(("change", "told"), [({"normalized": True}, "without quantization"),
                                              ({"sparse": {"count": 1}}, "without sparse accessors")])
def test_vertices_of_a_gltf_that_would_be_misread_are_refused(tmp_path: Path, change: dict[str, Any], told: str) -> None:
    path, content = gltf(tmp_path)
    content["accessors"][content["meshes"][0]["primitives"][0]["attributes"]["POSITION"]] |= change
    path.write_text(json.dumps(content))
    with pytest.raises(ObjectError, match=told):
        load_file(path)


def test_an_off_file_of_polygons_is_told_to_be_exported_in_triangles(tmp_path: Path) -> None:
    faces = ["5 0 1 2 3 4", "3 0 1 5", "3 1 2 5", "3 2 3 5", "3 3 4 5", "3 4 0 5"]
    corners = [f"{0.05 * np.cos(a):.6f} {0.05 * np.sin(a):.6f} 0" for a in np.arange(5) * 2 * np.pi / 5]
    (tmp_path / "cone.off").write_text("\n".join(["OFF", "6 6 0", *corners, "0 0 0.06", *faces]) + "\n")
    with pytest.raises(ObjectError, match="its faces have unequal numbers of corners; export it in triangles"):
        load_file(tmp_path / "cone.off")


@pytest.mark.parametrize("corner", ["{v}", "{v}//{n}", "{v}/{t}/{n}", "{v}/{t}"])
def test_negative_indices_of_an_obj_count_from_the_last_line_so_far(tmp_path: Path, corner: str) -> None:
    lines = []
    for at in (0.0, 0.052):
        box = trimesh.creation.box((0.04, 0.05, 0.06)).apply_translation((at, 0, 0))
        for x, y, z in box.vertices:
            lines += [f"v {x} {y} {z}", "vt 0 0", "vn 0 0 1"]
        lines += ["f " + " ".join(corner.format(v=i - 8, t=i - 8, n=i - 8) for i in face) for face in box.faces]
    (tmp_path / "two.obj").write_text("\n".join(lines))
    obj = load_file(tmp_path / "two.obj")
    assert obj.volume == pytest.approx(2 * 0.04 * 0.05 * 0.06, rel=1e-5)
    assert obj.extents[0] == pytest.approx(0.092, abs=1e-6)


@pytest.mark.parametrize("suffix", ["gltf", "glb"])
@pytest.mark.parametrize("name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression"])
def test_compressed_meshes_of_a_gltf_are_told(tmp_path: Path, suffix: str, name: str) -> None:
    path, content = gltf(tmp_path)
    text = json.dumps(content | {"extensionsUsed": [name], "extensionsRequired": [name]}).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A)
    path = path.with_suffix(f".{suffix}")
    path.write_bytes((head if suffix == "glb" else b"") + text)
    with pytest.raises(ObjectError, match=rf"its meshes are compressed \({name}\); export it without compression"):
        load_file(path)


def test_bodies_that_touch_or_nearly_do_are_one_thing(tmp_path: Path) -> None:
    balls = [sphere(0.02, (0.041 * number, 0, 0)) for number in range(3)]
    assert load_file(save(trimesh.util.concatenate(balls), tmp_path / "chain.ply")).notes == ("3 separate bodies",)


def test_overlapping_bodies_are_joined(tmp_path: Path):
    r, d = 0.03, 0.029
    mesh = trimesh.util.concatenate([sphere(r), sphere(r, (d, 0, 0))])
    obj = load_file(save(mesh, tmp_path / "two.ply"))
    shared = np.pi * (4 * r + d) * (2 * r - d) ** 2 / 12
    assert obj.volume == pytest.approx(8 / 3 * np.pi * r**3 - shared, rel=0.02)
    assert obj.notes == ("2 overlapping bodies were joined",)
    assert trimesh.Trimesh(obj.vertices, obj.faces, process=False).is_volume


def test_scale_applies_to_a_mesh_in_millimetres(tmp_path: Path):
    path = save(sphere(30), tmp_path / "ball.stl")
    with pytest.raises(ObjectError, match=r"measures 60 m, too large .*give scale=0.001 for millimetres, .* 6 cm$"):
        load_file(path)
    assert load_file(path, scale=0.001).extents[0] == pytest.approx(0.06, abs=1e-6)


@pytest.mark.parametrize(("suffix", "size", "hints"), [
    ("stl", 355.0, ["0.001 for millimetres, which makes it 35.5 cm"]),
    ("stl", 10.0, ["0.001 for millimetres, which makes it 1 cm", "0.01 for centimetres, which makes it 10 cm",
                   "0.0254 for inches, which makes it 25.4 cm"]),
    ("ply", 10.0, ["0.01 for centimetres, which makes it 10 cm", "0.0254 for inches, which makes it 25.4 cm",
                   "0.001 for millimetres, which makes it 1 cm"]),
    ("obj", 20.0, ["0.01 for centimetres, which makes it 20 cm", "0.001 for millimetres, which makes it 2 cm"]),
    ("ply", 1.5, ["0.0254 for inches, which makes it 3.81 cm", "0.01 for centimetres, which makes it 1.5 cm"]),
    ("ply", 5000.0, ["1e-05 makes it 5 cm"]), ("ply", 0.002, ["100 makes it 20 cm"])])
def test_unlikely_sizes_are_refused_with_the_scales_of_units(tmp_path: Path, suffix: str, size: float, hints: list[str]):
    with pytest.raises(ObjectError, match=r"too (large|small) for a hand to grasp") as caught:
        load_file(save(sphere(size / 2), tmp_path / f"ball.{suffix}"))
    assert str(caught.value).partition("scale=")[2].split("; scale=") == hints


def test_suggested_scale_is_accepted_and_takes_the_place_of_the_one_given(tmp_path: Path):
    path = save(sphere(50.0), tmp_path / "ball.ply")
    for scale in (0.5, 1e-5):
        with pytest.raises(ObjectError, match=r"scale=0.001 for millimetres, which makes it 10 cm"):
            load_file(path, scale=scale)
    assert load_file(path, scale=0.001).extents[0] == pytest.approx(0.1)
    path = save(sphere(0.05), tmp_path / "metres.ply")
    with pytest.raises(ObjectError, match=r"0.1 mm, too small .*scale=1 for metres, which makes it 10 cm$"):
        load_file(path, scale=0.001)


def test_missing_file_is_named(tmp_path: Path):
    with pytest.raises(ObjectError, match=r"no object file at .*mug\.obj; give an existing mesh"):
        load_file(tmp_path / "mug.obj")


def test_inverted_mesh_is_turned(tmp_path: Path):
    mesh = sphere(at=(0.1, 0, 0))
    mesh.invert()
    obj = load_file(save(mesh, tmp_path / "ball.ply"))
    assert obj.notes == ("faces were turned outward",)
    assert ((obj.cloud - (0.1, 0, 0)) * obj.cloud_normals).sum(1).min() > 0
    assert obj.volume > 0


def test_some_flipped_faces_are_turned(tmp_path: Path):
    mesh = sphere()
    faces = mesh.faces.copy()
    faces[::7] = faces[::7, ::-1]
    obj = load_file(save(trimesh.Trimesh(mesh.vertices, faces, process=False), tmp_path / "ball.ply"))
    assert (obj.cloud * obj.cloud_normals).sum(1).min() > 0


@pytest.mark.parametrize("inverted", [False, True])
def test_open_shell_keeps_its_volume_and_outside(tmp_path: Path, inverted: bool):
    mesh = sphere(at=(0.3, 0.2, 0))  # far from the origin, where an open mesh's own volume is meaningless
    cut = mesh.slice_plane((0.3, 0.2, 0.024), (0, 0, -1))
    if inverted:
        cut.invert()
    obj = load_file(save(cut, tmp_path / "shell.ply"))
    assert any("not watertight" in note for note in obj.notes)
    assert obj.volume == pytest.approx(mesh.volume, rel=0.05)
    np.testing.assert_allclose(obj.centre_of_mass, (0.3, 0.2, 0), atol=2e-3)
    expected = 2 / 5 * obj.volume * 0.03**2
    np.testing.assert_allclose(np.diag(obj.inertia), expected, rtol=0.1)
    assert ((obj.cloud - (0.3, 0.2, 0)) * obj.cloud_normals).sum(1).mean() > 0.02


@pytest.mark.parametrize("cut", [0.0, -0.02, 0.025])
def test_a_bowl_without_thickness_is_told_to_be_solid(tmp_path: Path, cut: float) -> None:
    bowl = sphere().slice_plane((0, 0, cut), (0, 0, -1))
    obj = load_file(save(bowl, tmp_path / "bowl.ply"))
    assert any("so it is solid here; if it is hollow" in note for note in obj.notes)


def test_a_box_without_lid_is_told_to_be_solid_and_small_holes_are_not(tmp_path: Path) -> None:
    box, ball = trimesh.creation.box((0.06, 0.06, 0.06)), sphere()
    box.update_faces(box.face_normals[:, 2] < 0.5)
    ball.update_faces(np.arange(len(ball.faces)) % 7 != 0)
    assert "so it is solid here" in load_file(save(box, tmp_path / "box.ply")).notes[0]
    assert load_file(save(ball, tmp_path / "ball.ply")).notes == ("holes were closed",)


def test_bent_sheet_weighs_as_its_hull(tmp_path: Path):
    obj = load_file(save(saddle(), tmp_path / "sheet.ply"))
    assert obj.volume == pytest.approx(saddle().convex_hull.volume)
    assert any("convex hull" in note for note in obj.notes)


def test_duplicated_vertices_are_merged(tmp_path: Path):
    lines = ["v 0 0 0", "v 0.05 0 0", "v 0 0.05 0", "v 0 0 0.05", "v 0 0 0"]
    (tmp_path / "t.obj").write_text("\n".join([*lines, "f 1 3 2", "f 1 2 4", "f 5 4 3", "f 2 3 4"]))
    obj = load_file(tmp_path / "t.obj")
    assert obj.notes == ("merged 1 duplicated vertices",)
    assert obj.volume == pytest.approx(0.05**3 / 6)


def test_dense_meshes_are_decimated(tmp_path: Path):
    turn, tube = np.meshgrid(*2 * [np.linspace(0, 2 * np.pi, 350, endpoint=False)], indexing="ij")
    reach = 0.04 + 0.015 * np.cos(tube)
    vertices = np.stack([reach * np.cos(turn), reach * np.sin(turn), 0.015 * np.sin(tube)], -1).reshape(-1, 3)
    index = np.arange(350**2).reshape(350, 350)
    a, b, c, d = (np.roll(index, shift, (0, 1)).ravel() for shift in ((0, 0), (-1, 0), (-1, -1), (0, -1)))
    mesh = trimesh.Trimesh(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]), process=False)
    assert len(mesh.faces) > 200_000
    obj = load_file(save(mesh, tmp_path / "dense.stl"))
    assert obj.faces is not None
    assert len(obj.faces) <= 50_000
    assert obj.notes[0].startswith(f"decimated from {len(mesh.faces)} to ")
    assert obj.volume == pytest.approx(mesh.volume, rel=1e-3)


def obj_file(path: Path, vertices: np.ndarray, faces: np.ndarray, head: str = "") -> Path:
    lines = [head, *(f"v {x} {y} {z}" for x, y, z in vertices), *(f"f {a} {b} {c}" for a, b, c in faces + 1)]
    path.write_text("\n".join(lines))
    return path


def test_faces_without_area_and_soups_are_refused_at_once(tmp_path: Path) -> None:
    draw = np.random.default_rng(0)
    points, line = draw.uniform(-0.05, 0.05, (1800, 3)), np.linspace(-0.05, 0.05, 30)[:, None] * np.ones(3)
    for vertices, faces, message in (
        (points[:30], np.repeat(np.arange(30)[:, None], 3, 1), "none of which has an area"),
        (line, np.arange(30).reshape(-1, 3), "none of which has an area"),
        (points, np.arange(1800).reshape(-1, 3), "is no surface: 100%"),
        (points[:300], draw.permutation(1800).reshape(-1, 3) % 300, "is no surface: 9.%"),
        (points, np.concatenate([np.arange(1800).reshape(-1, 3), np.arange(1800)[::-1].reshape(-1, 3)]), "is no surface: 100%"),
    ):
        with pytest.raises(ObjectError, match=message):
            load_file(obj_file(tmp_path / "o.obj", vertices, faces))


def test_meshes_and_clouds_far_from_their_origin_are_refused(tmp_path: Path) -> None:
    box = trimesh.creation.box((0.05, 0.05, 0.05))
    with pytest.raises(ObjectError, match=r"coordinates of up to 1e\+09 m, too large"):
        load_file(obj_file(tmp_path / "o.obj", box.vertices + 1e9, box.faces))
    np.save(tmp_path / "c.npy", np.random.default_rng(0).normal(0, 0.04, (500, 3)) + 1e6)
    with pytest.raises(ObjectError, match=r"coordinates of up to 1e\+06 m, too large"):
        load_file(tmp_path / "c.npy")


def test_an_archive_that_unpacks_to_much_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with zipfile.ZipFile(tmp_path / "bomb.3mf", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("3D/3dmodel.model", b" " * 3_000_000)
    monkeypatch.setattr(mesh_files, "MAX_BYTES", 2_000_000)
    with pytest.raises(ObjectError, match=r"it holds 3 MB, the limit is 2"):
        load_file(tmp_path / "bomb.3mf")


def test_files_that_a_mesh_names_are_plain_ones_beside_it(tmp_path: Path) -> None:
    box = trimesh.creation.box((0.05, 0.05, 0.05))
    os.mkfifo(tmp_path / "pipe.mtl")
    assert load_file(obj_file(tmp_path / "o.obj", box.vertices, box.faces, "mtllib pipe.mtl")).volume == pytest.approx(0.05**3)
    (tmp_path / "in").mkdir()
    for name, content in trimesh.exchange.gltf.export_gltf(box).items():
        (tmp_path / "in" / name).write_bytes(content)
    assert load_file(tmp_path / "in" / "model.gltf").volume == pytest.approx(0.05**3)
    for file in (tmp_path / "in").glob("*.bin"):
        file.rename(tmp_path / file.name)
        text = (tmp_path / "in" / "model.gltf").read_text().replace(file.name, f"../{file.name}")
        (tmp_path / "in" / "model.gltf").write_text(text)
    with pytest.raises(ObjectError, match="no such file beside it"):
        load_file(tmp_path / "in" / "model.gltf")


def sides_of(extents: tuple[float, float, float], *normals: tuple[int, int, int]) -> trimesh.Trimesh:
    """A box of which the sides with these normals are there alone."""
    mesh = trimesh.creation.box(extents)
    mesh.update_faces((mesh.face_normals @ np.transpose(normals) > 0.9).any(1))
    mesh.remove_unreferenced_vertices()
    return mesh


CUBE = (0.1, 0.1, 0.1)
DOWN, LEFT, RIGHT, FRONT, BACK = (0, 0, -1), (-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0)


@pytest.mark.parametrize("mesh", [
    trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], [[0, 1, 2], [0, 3, 1]]),
    sides_of(CUBE, DOWN, LEFT), sides_of(CUBE, DOWN, LEFT, RIGHT), sides_of(CUBE, DOWN, LEFT, FRONT),
    sides_of(CUBE, LEFT, RIGHT),
], ids=["two triangles", "two sides", "three sides in a row", "a corner", "two sides apart"])
def test_open_sheets_of_few_faces_are_refused(mesh: trimesh.Trimesh, tmp_path: Path) -> None:
    with pytest.raises(ObjectError, match="is an open sheet and encloses nothing"):
        load_file(save(mesh, tmp_path / "sheet.stl"))


@pytest.mark.parametrize(("mesh", "volume"), [
    (sides_of(CUBE, DOWN, LEFT, RIGHT, FRONT, BACK), 1e-3),
    (sides_of((0.2, 0.2, 0.02), DOWN, LEFT, RIGHT, FRONT, BACK), 8e-4),
    (sides_of(CUBE, LEFT, RIGHT, FRONT, BACK), 1e-3),
    (trimesh.Trimesh(*(lambda box: (box.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3)))(trimesh.creation.box(CUBE)),
                     process=False), 1e-3),
], ids=["without a lid", "a tray", "a tube", "loose faces"])
def test_open_meshes_of_few_faces_that_enclose_are_taken(mesh: trimesh.Trimesh, volume: float, tmp_path: Path) -> None:
    obj = load_file(save(mesh, tmp_path / "open.stl"))
    assert obj.volume == pytest.approx(volume, rel=0.15)


def loose(mesh: trimesh.Trimesh, *turned: int, apart: float = 0.0) -> trimesh.Trimesh:
    """The mesh with its own corners for each face, some faces turned, and corners that lie `apart` [m]."""
    corners = np.array(mesh.triangles)
    corners[list(turned)] = corners[list(turned), ::-1]
    corners = corners.reshape(-1, 3) + np.random.default_rng(0).normal(0, apart, (3 * len(corners), 3))
    return trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)


@pytest.mark.parametrize("mesh", [
    *(loose(sides_of(CUBE, LEFT, RIGHT, FRONT, BACK), face) for face in (0, 3, 7)),
    *(loose(trimesh.creation.box(CUBE), *range(first, 12, 3), apart=1e-5) for first in range(3)),
], ids=["tube 0", "tube 3", "tube 7", "faces 0", "faces 1", "faces 2"])
def test_open_meshes_of_mixed_winding_are_judged_as_they_are_repaired(mesh: trimesh.Trimesh, tmp_path: Path) -> None:
    assert load_file(save(mesh, tmp_path / "open.ply")).volume == pytest.approx(1e-3, rel=0.15)


@pytest.mark.parametrize("doubled", [slice(None, None, -1), slice(None)], ids=["reversed", "repeated"])
@pytest.mark.parametrize("normals", [(DOWN, LEFT), (DOWN, LEFT, RIGHT), (DOWN, LEFT, FRONT), (LEFT, RIGHT)])
def test_sheets_of_doubled_faces_are_sheets(normals: tuple[tuple[int, int, int], ...], doubled: slice, tmp_path: Path) -> None:
    sheet = sides_of(CUBE, *normals)
    both = trimesh.Trimesh(sheet.vertices, np.concatenate([sheet.faces, sheet.faces[:, doubled]]), process=False)
    with pytest.raises(ObjectError, match="is an open sheet and encloses nothing"):
        load_file(save(both, tmp_path / "sheet.ply"))


def test_loose_faces_of_a_hollow_thing_are_no_sheet(tmp_path: Path) -> None:
    """A frame of two bars whose faces do not meet, and which fills a third of its hull."""
    bars = [trimesh.creation.box((0.1, 0.02, 0.02)).apply_translation((0.05, 0, 0)),
            trimesh.creation.box((0.02, 0.02, 0.1)).apply_translation((0, 0, 0.061))]
    corners = trimesh.util.concatenate(bars).triangles.reshape(-1, 3)
    apart = corners + np.random.default_rng(0).normal(0, 1e-5, corners.shape)
    obj = load_file(save(trimesh.Trimesh(apart, np.arange(72).reshape(-1, 3), process=False), tmp_path / "bars.ply"))
    np.testing.assert_allclose(np.ptp(obj.cloud, axis=0), np.ptp(corners, axis=0), atol=2e-3)
