"""Bare clouds: read from files, refused, thinned, and given normals."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import KDTree

from dro_grasp.errors import DroGraspError, ObjectError
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.loading import cloud_object, estimate_normals, load_file
from dro_grasp.objects.reading import read_cloud, read_rows
from dro_grasp.objects.shape import CLOUD_POINTS


def directions(count: int, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def test_cloud_from_npy(tmp_path: Path):
    np.save(tmp_path / "c.npy", 0.04 * directions(3000))
    obj = load_file(tmp_path / "c.npy")
    assert obj.is_cloud
    assert obj.cloud.shape == (3000, 3)
    assert ((obj.cloud / 0.04) * obj.cloud_normals).sum(1).min() > 0.9
    assert obj.volume == 0
    assert "normals were estimated" in obj.notes[0]


def test_one_side_alone_is_asked_about(tmp_path: Path):
    ball = 0.04 * directions(3000)
    box = 0.04 * np.random.default_rng(2).uniform(-1, 1, (3000, 3))
    box[np.arange(3000), np.arange(3000) % 3] = 0.04 * np.sign(box[np.arange(3000), np.arange(3000) % 3])
    for whole in (ball, box):
        corner = whole @ np.ones(3) / np.sqrt(3)
        for points, asked in ((whole, False), (whole[corner > 0.01], True)):
            np.save(tmp_path / "c.npy", points)
            notes = load_file(tmp_path / "c.npy").notes
            assert any("camera=" in note for note in notes) == asked
    seen = ball[ball[:, 2] > 0]
    np.save(tmp_path / "c.npy", np.concatenate([seen, seen], 1))
    assert not any("camera=" in note for note in load_file(tmp_path / "c.npy").notes), "its normals were given"


def test_given_normals_are_kept_and_not_scaled(tmp_path: Path):
    normals = directions(500)
    np.save(tmp_path / "c.npy", np.concatenate([40 * normals, 3 * normals], 1))
    obj = load_file(tmp_path / "c.npy", scale=0.001)
    assert obj.extents.max() < 0.081
    assert "estimated" not in obj.notes[0]
    kept, given = obj.cloud_normals, normals.astype(np.float32)
    np.testing.assert_allclose(kept[np.lexsort(kept.T)], given[np.lexsort(given.T)], atol=1e-6)


def test_zero_normals_are_estimated(tmp_path: Path):
    np.save(tmp_path / "c.npy", np.concatenate([0.04 * directions(500), np.zeros((500, 3))], 1))
    np.testing.assert_allclose(np.linalg.norm(load_file(tmp_path / "c.npy").cloud_normals, axis=1), 1, atol=1e-5)


@pytest.mark.parametrize("suffix", ["ply", "glb", "obj"])
def test_faceless_file_is_a_cloud(tmp_path: Path, suffix: str):
    points = 0.04 * directions(200)
    path = tmp_path / f"c.{suffix}"
    if suffix == "obj":
        path.write_text("\n".join(f"v {x} {y} {z}" for x, y, z in points))
    else:
        trimesh.PointCloud(points).export(path)
    obj = load_file(path)
    assert obj.is_cloud
    np.testing.assert_allclose(obj.centre_of_mass, points.mean(0), atol=1e-6)


def pcd(points: np.ndarray, kind: str) -> bytes:
    names = "x y z normal_x normal_y normal_z"
    count = points.shape[1]
    head = (f"# .PCD v0.7\nVERSION 0.7\nFIELDS rgb {' '.join(names.split()[:count])}\nSIZE 4{' 4' * count}\n"
            f"TYPE U{' F' * count}\nCOUNT 2{' 1' * count}\nWIDTH {len(points)}\nHEIGHT 1\n"
            f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA {kind}\n").encode()
    if kind == "ascii":
        return head + "".join(f"7 8 {' '.join(map(str, row))}\n" for row in points).encode()
    if kind == "binary_compressed":
        columns = struct.pack("<II", 7, 8) * len(points) + points.T.astype("<f4").tobytes()
        packed = lzf(columns)
        return head + struct.pack("<II", len(packed), len(columns)) + packed
    return head + b"".join(struct.pack(f"<II{count}f", 7, 8, *row) for row in points)


def lzf(data: bytes) -> bytes:
    """A plain LZF packer: runs as they are, and copies of what stands at most 8 kB before. Source: the format of liblzf."""
    packed, plain, seen, at = bytearray(), bytearray(), {}, 0

    def flush() -> None:
        for i in range(0, len(plain), 32):
            run = plain[i : i + 32]
            packed.extend([len(run) - 1, *run])
        plain.clear()

    while at < len(data):
        before, seen[data[at : at + 3]] = seen.get(data[at : at + 3]), at
        length = 0
        while before is not None and at - before <= 8192 and length < 264 and at + length < len(data) and (
                data[before + length] == data[at + length]):
            length += 1
        if length < 3:
            plain.append(data[at])
            at += 1
            continue
        flush()
        back = at - before - 1
        packed.extend([(min(length - 2, 7) << 5) | back >> 8, *([length - 9] if length >= 9 else []), back & 255])
        at += length
    flush()
    return bytes(packed)


@pytest.mark.parametrize("write", [str.lower, str.upper])
def test_keys_of_a_pcd_are_read_in_small_letters_and_capitals(tmp_path: Path, write: Callable[[str], str]) -> None:
    head = ["VERSION 0.7", "FIELDS x y z", "SIZE 4 4 4", "TYPE F F F", "WIDTH 300", "HEIGHT 1", "POINTS 300", "DATA ascii"]
    keys = [" ".join([write(line.split()[0]), *line.split()[1:]]) for line in head[:-1]] + [write(head[-1])]
    rows = [" ".join(f"{value:.6f}" for value in point) for point in 0.04 * directions(300)]
    (tmp_path / "c.pcd").write_text("\n".join(keys + rows) + "\n")
    assert len(load_file(tmp_path / "c.pcd").cloud) == 300


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("width", [3, 6])
def test_cloud_from_pcd(tmp_path: Path, kind: str, width: int):
    points = np.concatenate([0.04 * directions(300), directions(300)], 1)[:, :width]
    (tmp_path / "c.pcd").write_bytes(pcd(points, kind))
    obj = load_file(tmp_path / "c.pcd")
    order, given = np.lexsort(obj.cloud.T), np.lexsort(points[:, :3].astype(np.float32).T)
    np.testing.assert_allclose(obj.cloud[order], points[given, :3], atol=1e-7)
    if width == 6:
        np.testing.assert_allclose(obj.cloud_normals[order], points[given, 3:], atol=1e-6)


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
def test_cut_pcd_is_refused(tmp_path: Path, kind: str):
    whole = pcd(0.04 * directions(300), kind)
    middle = len(whole) * 3 // 4
    for end in (middle, whole.find(b"\n", middle) + 1):  # within a row, and after one
        (tmp_path / "c.pcd").write_bytes(whole[:end])
        with pytest.raises(ObjectError, match=r"promises 300 points|damaged"):
            load_file(tmp_path / "c.pcd")


@pytest.mark.parametrize(
    ("points", "message"),
    [(np.zeros((0, 3)), "0 distinct points"), (np.zeros((20, 4)), r"shape \(20, 4\); expected \(n, 3\)"),
     (np.zeros(30), r"shape \(30,\)"), (np.array(["a", "b"]), "expected a plain NPY array")])
def test_unusable_clouds_are_refused(tmp_path: Path, points: np.ndarray, message: str):
    np.save(tmp_path / "c.npy", points)
    with pytest.raises(ObjectError, match=message):
        load_file(tmp_path / "c.npy")


def test_npy_with_objects_or_noise_is_refused(tmp_path: Path):
    np.save(tmp_path / "c.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(ObjectError, match="expected a plain NPY array"):
        load_file(tmp_path / "c.npy")
    (tmp_path / "c.npy").write_bytes(b"")
    with pytest.raises(ObjectError, match="expected a plain NPY array"):
        load_file(tmp_path / "c.npy")


def test_points_on_one_line_are_no_object(tmp_path: Path) -> None:
    """They may be a slider's or a laser's; a planar cloud is taken, and so is a thin wire."""
    along = np.linspace(0, 0.2, 100)[:, None] * (0.6, 0.8, 0)
    np.save(tmp_path / "c.npy", along)
    with pytest.raises(ObjectError, match=r"100 points of .* lie on one line"):
        load_file(tmp_path / "c.npy")
    np.save(tmp_path / "c.npy", along + 5e-4 * directions(100))
    assert len(load_file(tmp_path / "c.npy").cloud) == 100


def test_planar_cloud_works(tmp_path: Path):
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (400, 3)) * (1, 1, 0)
    np.save(tmp_path / "c.npy", points)
    obj = load_file(tmp_path / "c.npy")
    np.testing.assert_allclose(np.abs(obj.cloud_normals[:, 2]), 1, atol=1e-5)


def test_huge_cloud_is_thinned_the_same_way_every_time(tmp_path: Path):
    np.save(tmp_path / "c.npy", 0.04 * directions(100_000))
    first, second = load_file(tmp_path / "c.npy"), load_file(tmp_path / "c.npy")
    assert len(first.cloud) == CLOUD_POINTS
    np.testing.assert_array_equal(first.cloud, second.cloud)
    assert first.sha256 == second.sha256
    assert f"{CLOUD_POINTS} of them kept" in first.notes[0]


BALL = 0.04 * directions(1500)
NEAR = np.random.default_rng(3).normal(size=(300, 3))


@pytest.mark.parametrize("points", [
    np.concatenate([BALL, BALL[:1]]), np.concatenate([BALL, np.tile(BALL[:1], (300, 1))]), np.tile(BALL, (8, 1)),
    np.concatenate([BALL, np.tile(BALL[:1], (60_000, 1))]), np.concatenate([BALL, BALL[:1] + 1e-9 * NEAR]),
], ids=["one twice", "one often", "all often", "mostly one", "too near for single precision"])
def test_points_that_coincide_are_one(points: np.ndarray) -> None:
    """Trees that divide space until each cell has one point never end on them; the ball is the oracle."""
    obj = cloud_object("ball", points, origin="ball")
    assert 0 <= len(obj.cloud) - len(BALL) < 8, "points of one place lie in at most 8 cubes"
    assert f"merged {len(points) - len(obj.cloud)} duplicated points" in obj.notes
    places = np.random.default_rng(4).uniform(-0.06, 0.06, (500, 3))
    radius = np.linalg.norm(places, axis=1)
    found = obj.distance_field.distances(torch.from_numpy(places).float())[0].numpy()
    assert np.abs(found - (radius - 0.04))[radius > 0.01].max() < 0.005


def test_estimated_normals_of_a_box_point_outward():
    points, face = trimesh.sample.sample_surface(trimesh.creation.box((0.1, 0.1, 0.1)), 4000, seed=0)[:2]
    normals = estimate_normals(np.asarray(points, np.float32))
    true = trimesh.creation.box((0.1, 0.1, 0.1)).face_normals[face]
    inner = np.sort(np.abs(points), axis=1)[:, 1] < 0.04  # away from the edges
    assert (normals * true).sum(1)[inner].min() > 0.98


@pytest.mark.parametrize("header", [
    "{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000, 3), }",
    "{'descr': '<U0', 'fortran_order': False, 'shape': (99999999, 3), }", "{'descr': '<f8', 'shape': (",
    "{'descr': '|O', 'fortran_order': False, 'shape': (3,), }",
])
def test_npy_headers_that_lie_are_refused_without_the_memory_that_they_ask_for(tmp_path: Path, header: str) -> None:
    size = (len(header) + 1).to_bytes(2, "little")
    (tmp_path / "c.npy").write_bytes(b"\x93NUMPY\x01\x00" + size + header.encode() + b"\n" + bytes(99))
    with pytest.raises(ObjectError, match="expected a plain NPY array"):
        load_file(tmp_path / "c.npy")


def test_a_header_that_claims_to_be_longer_than_the_file_is_refused_before_it_is_read(tmp_path: Path) -> None:
    (tmp_path / "long.npy").write_bytes(b"\x93NUMPY\x02\x00" + (2**32 - 1).to_bytes(4, "little") + b"{}")
    with pytest.raises(ObjectError, match="its header claims 4294967295 bytes"):
        load_file(tmp_path / "long.npy")


def ply(path: Path, points: np.ndarray, normals: np.ndarray) -> Path:
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    text = "\n".join(" ".join(f"{value:.7f}" for value in row) for row in np.hstack([points, normals]))
    path.write_text(f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n{names}end_header\n{text}\n")
    return path


def bowl(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Both sides of a deep bowl of 6 mm: estimated normals would be wrong on its inside."""
    normals = directions(count)
    normals = normals[normals[:, 2] < 0.5]
    outer = np.arange(len(normals)) % 2 == 0
    return normals * np.where(outer, 0.05, 0.044)[:, None], normals * np.where(outer, 1, -1)[:, None]


def test_outward_unit_normals_of_a_ply_cloud_are_kept(tmp_path: Path) -> None:
    points, normals = bowl(3000)
    obj = load_file(ply(tmp_path / "bowl.ply", points, normals))
    near = KDTree(points).query(obj.cloud)[1]
    np.testing.assert_allclose(obj.cloud_normals, normals[near], atol=1e-5)
    assert "estimated" not in obj.notes[0]
    assert len(obj.notes) == 1


def test_normals_of_a_ply_cloud_that_point_inward_are_turned(tmp_path: Path) -> None:
    points, normals = bowl(3000)
    obj = load_file(ply(tmp_path / "bowl.ply", points, -normals))
    np.testing.assert_allclose(obj.cloud_normals, normals[KDTree(points).query(obj.cloud)[1]], atol=1e-5)
    assert "its normals pointed inward and were turned" in obj.notes


@pytest.mark.parametrize("kind", ["of other lengths", "some absent", "all zero", "of no side"])
def test_other_normals_of_a_ply_cloud_are_estimated_and_it_is_said(tmp_path: Path, kind: str) -> None:
    points = 0.04 * directions(2000)
    given = points / 0.04
    if kind == "of other lengths":
        given = given * np.random.default_rng(1).uniform(0, 3, (2000, 1))
    elif kind == "of no side":
        given = given * np.random.default_rng(1).choice([-1, 1], (2000, 1))
    else:
        given[:: 1 if kind == "all zero" else 9] = 0 if kind == "all zero" else np.nan
    obj = load_file(ply(tmp_path / "ball.ply", points, given))
    assert ((obj.cloud / 0.04) * obj.cloud_normals).sum(1).min() > 0.9
    assert "normals were estimated" in obj.notes[0]
    assert any("were not used" in note for note in obj.notes)


def test_cavities_of_a_cloud_without_normals_are_told_to_be_filled() -> None:
    points, normals = bowl(3000)
    filled, hollow = load_object(points), load_object(np.hstack([points, normals]))
    inside = torch.tensor([[0.0, 0.0, -0.036]])
    assert float(filled.distance_field.distances(inside)[0]) < 0 < float(hollow.distance_field.distances(inside)[0])
    assert "cavities, as in a bowl, count as filled" in filled.notes[0]
    assert "cavities" not in "".join(hollow.notes)


def test_normals_of_arrays_are_judged_as_those_of_files() -> None:
    points, normals = bowl(3000)
    turned = load_object(np.hstack([points, -normals]))
    np.testing.assert_allclose(turned.cloud_normals, normals[KDTree(points).query(turned.cloud)[1]], atol=1e-5)
    assert "its normals pointed inward and were turned" in turned.notes
    ball, some = 0.04 * directions(2000), np.random.default_rng(1).choice([-1, 1], (2000, 1))
    mixed = load_object(np.hstack([ball, ball / 0.04 * some]))
    assert ((mixed.cloud / 0.04) * mixed.cloud_normals).sum(1).min() > 0.9
    assert "its normals point to both sides of one surface, so they were not used" in mixed.notes


def test_normals_of_a_thin_sheet_point_to_both_sides(tmp_path: Path) -> None:
    flat = np.random.default_rng(0).uniform(-0.03, 0.03, (4000, 3))
    flat[:, 2], normals = np.where(np.arange(4000) % 2, 4e-4, -4e-4), np.zeros((4000, 3))
    normals[:, 2] = np.sign(flat[:, 2])
    obj = load_file(ply(tmp_path / "card.ply", flat, normals))
    np.testing.assert_allclose(obj.cloud_normals[:, 2], np.sign(obj.cloud[:, 2]), atol=1e-6)


GAPS = {"NaN": np.nan, "infinity": np.inf, "zero": 0.0}


@pytest.mark.parametrize("gap", GAPS)
@pytest.mark.parametrize("form", ["npy", "organised npy", "pcd", "compressed pcd", "memory"])
def test_pixels_without_a_return_are_dropped_and_counted(tmp_path: Path, gap: str, form: str) -> None:
    image = np.full((40, 30, 3), GAPS[gap])
    image[5:35, 5:25] = (0.04 * directions(600) + [0, 0, 0.5]).reshape(30, 20, 3)
    rows, path = image.reshape(-1, 3), tmp_path / f"c.{form[-3:]}"
    if "npy" in form:
        np.save(path, image if "organised" in form else rows)
    elif "pcd" in form:
        path.write_bytes(pcd(rows, "binary_compressed" if "compressed" in form else "ascii"))
    obj = load_object(image if form == "memory" else path)
    assert len(obj.cloud) == 600
    assert obj.cloud[:, 2].min() > 0.45
    assert any(note.startswith("600 of 1200 points are none") for note in obj.notes)


def test_a_point_of_the_object_at_the_origin_is_kept() -> None:
    grid = 0.002 * (np.indices((21, 21, 1)).reshape(3, -1).T - [10, 10, 0])
    assert len(cloud_object("sheet", grid, origin="sheet").cloud) == 441
    alone = np.concatenate([0.04 * directions(500) + [0, 0, 0.5], np.zeros((1, 3))])
    assert len(cloud_object("ball", alone, origin="ball").cloud) == 500


@pytest.mark.parametrize("damage", ["size", "growth", "cut", "bytes"])
def test_damaged_compressed_pcd_is_refused(tmp_path: Path, damage: str) -> None:
    whole = pcd(0.04 * directions(300), "binary_compressed")
    start = whole.find(b"binary_compressed\n") + len(b"binary_compressed\n")
    if damage == "growth":  # 4 GB of three bytes
        whole = whole[:start].replace(b"POINTS 300", b"POINTS 200000000") + struct.pack("<II", 3, 4_000_000_000) + b"abc"
    elif damage == "size":
        whole = whole[: start + 4] + struct.pack("<I", 7) + whole[start + 8 :]
    elif damage == "cut":
        whole = whole[:-20]
    else:
        whole = whole[: start + 8] + b"\xff" * (len(whole) - start - 8)
    (tmp_path / "c.pcd").write_bytes(whole)
    with pytest.raises(ObjectError, match="it is damaged"):
        load_file(tmp_path / "c.pcd")


def test_an_organised_pcd_keeps_its_rows_and_columns(tmp_path: Path) -> None:
    whole = pcd(0.04 * directions(300), "binary").replace(b"WIDTH 300\nHEIGHT 1\n", b"WIDTH 20\nHEIGHT 15\n")
    (tmp_path / "c.pcd").write_bytes(whole)
    assert read_cloud(tmp_path / "c.pcd").shape == (15, 20, 3)
    assert len(load_file(tmp_path / "c.pcd").cloud) == 300


def test_a_pcd_header_without_points_states_rows_and_columns(tmp_path: Path) -> None:
    whole = pcd(0.04 * directions(300), "binary").replace(b"POINTS 300\n", b"")
    (tmp_path / "c.pcd").write_bytes(whole)
    assert len(load_file(tmp_path / "c.pcd").cloud) == 300


CYLINDER = trimesh.creation.cylinder(radius=0.03, height=0.1)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("meshes") / "can.ply"
    CYLINDER.export(path)
    return path


def in_millimetres() -> trimesh.Trimesh:
    mesh = CYLINDER.copy()
    mesh.apply_scale(1000)
    mesh.units = "mm"
    return mesh


@pytest.mark.parametrize("source", [
    CYLINDER, trimesh.Scene([CYLINDER]), (CYLINDER.vertices, CYLINDER.faces), in_millimetres(),
    (torch.as_tensor(np.asarray(CYLINDER.vertices)), torch.as_tensor(np.asarray(CYLINDER.faces)))], ids=str)
def test_a_mesh_in_memory_is_the_mesh_of_its_file(source, file: Path) -> None:
    obj, stored = load_object(source, name="can"), load_object(file)
    assert (obj.name, obj.file, stored.file) == ("can", None, str(file.resolve()))
    assert obj.volume == pytest.approx(stored.volume, rel=1e-5)
    np.testing.assert_allclose(obj.centre_of_mass, stored.centre_of_mass, atol=1e-6)
    np.testing.assert_allclose(obj.extents, (0.06, 0.06, 0.1), atol=1e-3)


@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor, trimesh.PointCloud])
def test_points_in_memory_are_a_bare_cloud(kind) -> None:
    points = CYLINDER.sample(500, seed=0)
    obj = load_object(kind(points), scale=0.5)
    assert obj.is_cloud
    assert obj.name == "cloud"
    np.testing.assert_allclose(obj.extents, np.ptp(points, axis=0) / 2, atol=1e-6)


@pytest.mark.parametrize(("source", "word"), [
    (np.zeros((4, 2)), r"shape \(4, 2\)"),
    ((np.zeros((4, 2)), np.zeros((1, 3), int)), r"vertices have shape \(4, 2\)"),
    ((np.eye(3), np.zeros((1, 4), int)), r"faces have shape \(1, 4\)"),
    ((np.eye(3), np.array([[0.0, 1, 2]])), "faces are numbers of type float64"),
    ((np.eye(3), np.array([[0, 1, 9]])), "vertex 9"), (trimesh.creation.box((9, 9, 9)), "too large")])
def test_what_is_no_object_is_refused_in_words(source, word: str) -> None:
    with pytest.raises(ObjectError, match=word):
        load_object(source)


@pytest.mark.usefixtures("as_users_have_it")
@pytest.mark.parametrize(("given", "told"), [
    ([1, 2], "^an object cannot be loaded from a list; give a name, the path of a mesh"),
    (7, "^an object cannot be loaded from a int"), (np.array([["a"] * 3]), "instead of numbers")], ids=["list", "int", "texts"])
def test_other_types_are_refused_in_words(given: Any, told: str) -> None:
    with pytest.raises(DroGraspError, match=told):
        load_object(given)


def test_the_scale_that_is_advised_counts_from_a_stated_unit(tmp_path: Path) -> None:
    mesh = trimesh.creation.box((2000, 2000, 2000))
    mesh.units = "mm"
    with pytest.raises(ObjectError, match=r"measures 2 m, .* scale=0.01 for centimetres, which makes it 2 cm"):
        load_object(mesh)
    assert load_object(mesh, scale=0.01).extents == pytest.approx((0.02, 0.02, 0.02))
    assert mesh.extents == pytest.approx((2000, 2000, 2000)), "what was given stays as it is"


def test_a_wrong_vertex_is_named(tmp_path: Path) -> None:
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]])
    for wrong in (-1, 3):
        with pytest.raises(ObjectError, match=rf"a face with vertex {wrong}, and vertices 0 to 2"):
            load_object((corners, np.array([[0, 1, wrong]])))


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_normals_of_a_cloud_file_are_read_in_any_encoding(tmp_path: Path, encoding: str) -> None:
    points = CYLINDER.sample(400, seed=1)
    normals = np.tile([0.0, 0.6, 0.8], (400, 1))
    rows = np.column_stack([points, normals]).astype(np.float32)
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    head = f"ply\nformat {encoding} 1.0\nelement vertex 400\n{names}end_header\n".encode()
    body = rows.astype("<f4").tobytes() if "binary" in encoding else "\n".join(" ".join(map(str, row)) for row in rows).encode()
    (tmp_path / "cloud.ply").write_bytes(head + body)
    np.testing.assert_allclose(read_rows(tmp_path / "cloud.ply")[:, 3:], normals, atol=1e-6)


def test_arrays_of_records_and_unknown_units_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "records.npy", np.zeros(2000, [("x", "f4"), ("y", "f4"), ("z", "f4")]))
    with pytest.raises(ObjectError, match="instead of numbers"):
        load_object(tmp_path / "records.npy")
    mesh = CYLINDER.copy()
    mesh.units = "furlong"
    with pytest.raises(ObjectError, match="its unit 'furlong' is unknown"):
        load_object(mesh)


def test_one_colour_for_all_points_is_no_normal() -> None:
    points = CYLINDER.sample(1500, seed=2)
    with pytest.raises(ObjectError, match="which are no normals"):
        load_object(np.column_stack([points, np.full((1500, 3), 128.0)]))


def test_an_inverted_body_counts_and_a_cavity_stays_one() -> None:
    outer, other = trimesh.creation.box((0.06, 0.06, 0.06)), trimesh.creation.box((0.05, 0.05, 0.05))
    other.invert()
    inside = trimesh.util.concatenate([outer, other])
    beside = trimesh.util.concatenate([outer, other.copy().apply_translation((0, 0, 0.056))])
    assert load_object(inside).volume == pytest.approx(0.06**3 - 0.05**3, rel=1e-3)
    found = load_object(beside)
    assert found.volume == pytest.approx(0.06**3 + 0.05**3, rel=1e-3)
    assert 0 < found.centre_of_mass[2] < 0.03
