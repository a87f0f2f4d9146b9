from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh

from dro_grasp.errors import ObjectError
from dro_grasp.objects.builtin import BUILTIN, make_builtin
from dro_grasp.objects.builtin.usual import OBJECTS
from dro_grasp.objects.catalogue import load_object, object_names, processed_objects, resolve_objects
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.objects.solids import box, frustum, hollow, ring, superquadric
from tests.helpers.bench_clone import clone_of_bars

NAMES = list(OBJECTS)


@pytest.fixture(scope="module")
def builtins() -> dict[str, ObjectModel]:
    return {name: make_builtin(name) for name in NAMES}


@pytest.fixture
def without_assets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DRO_GRASP_ASSETS", raising=False)


def small_assets(folder: Path) -> Path:
    """A stand-in for the development assets with one object of two parts, one without, and one that is missing."""
    objects = folder / "objects"
    objects.mkdir()
    parts = [trimesh.creation.box((0.04, 0.04, 0.04)), trimesh.creation.box((0.02, 0.02, 0.08))]
    trimesh.boolean.union(parts, engine="manifold").export(objects / "cross.obj")
    trimesh.util.concatenate(parts).export(objects / "parts.obj")
    (objects / "manifest.json").write_text(json.dumps([
        {"name": "set+cross", "file": "cross.obj", "multidex_split": "train", "collision": {"file": "parts.obj"}},
        {"name": "set+plain", "file": "cross.obj", "multidex_split": None, "collision": None},
        {"name": "set+gone", "file": "gone.obj", "multidex_split": "validate", "collision": None},
    ]))
    return folder


def test_enough_builtins_in_both_splits():
    splits = [kind.split for kind in OBJECTS.values()]
    assert len(splits) >= 36
    assert splits.count("train") >= 28
    assert splits.count("test") >= 8
    assert set(splits) == {"train", "test"}


def test_builtins_are_of_graspable_size(builtins: dict[str, ObjectModel]):
    for name, obj in builtins.items():
        assert 0.05 <= obj.extents.max() <= 0.2, name
        assert 0.02 < obj.extents.min() < 0.101, name
        assert 0.02 < obj.mass < 0.4, name


def test_builtins_are_the_same_every_time(builtins: dict[str, ObjectModel]):
    for name in ("mug", "torus", "hammer"):
        assert make_builtin(name).sha256 == builtins[name].sha256
    assert len({obj.sha256 for obj in builtins.values()}) == len(NAMES)


def test_volume_of_hollow_and_bent_solids():
    cup = hollow([(0.03, 0.0), (0.03, 0.08)], wall=0.005, floor=0.01, corners=64)
    ideal = np.pi * (0.03**2 * 0.08 - 0.025**2 * 0.07)
    assert cup.mesh.is_volume
    assert cup.mesh.volume == pytest.approx(ideal, rel=0.003)
    torus = ring(0.05, 0.01, corners=128)
    assert torus.mesh.is_volume
    assert torus.mesh.volume == pytest.approx(2 * np.pi**2 * 0.05 * 0.01**2, rel=0.07)  # ten corners to the tube
    half = ring(0.05, 0.01, corners=64, arc=np.pi, axis="y", at=(0.1, 0, 0))
    assert half.mesh.volume == pytest.approx(torus.mesh.volume / 2, rel=1e-6)
    np.testing.assert_allclose(half.mesh.bounds[:, 1], (-0.01, 0.01), atol=6e-4)
    assert sum(part.volume for part in half.parts) == pytest.approx(half.mesh.volume)


def test_vessel_whose_floor_would_miss_its_wall_is_refused():
    with pytest.raises(ValueError, match="floor must meet the wall"):
        hollow([(0.02, 0.0), (0.06, 0.02)], wall=0.005, floor=0.01)


def test_superquadrics_of_known_volume():
    assert superquadric((0.03, 0.04, 0.05), (1, 1)).volume == pytest.approx(4 / 3 * np.pi * 6e-5, rel=0.03)
    assert superquadric((0.03, 0.04, 0.05), (2, 2)).volume == pytest.approx(4 / 3 * 6e-5, rel=1e-6)
    assert superquadric((0.03, 0.04, 0.05), (0.05, 0.05)).volume == pytest.approx(8 * 6e-5, rel=0.05)


def test_boxes_and_frustums_stand_where_they_should():
    np.testing.assert_allclose(box((0.02, 0.04, 0.06), (0.1, 0, 0)).bounds, [[0.09, -0.02, -0.03], [0.11, 0.02, 0.03]])
    cone = frustum((0.03, 0.01), (0.0, 0.06), axis="x", corners=96)
    assert cone.volume == pytest.approx(np.pi * 0.06 / 3 * (9 + 3 + 1) * 1e-4, rel=2e-3)
    np.testing.assert_allclose(cone.bounds[:, 0], (0.0, 0.06), atol=1e-12)


def test_scaled_builtin_keeps_its_parts_in_place():
    whole, half = load_object("mug"), load_object("mug", scale=0.5)
    assert half.volume == pytest.approx(whole.volume / 8)
    assert half.split == "test"
    assert half.sha256 != whole.sha256
    np.testing.assert_allclose(half.parts[3][0], 0.5 * whole.parts[3][0])


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), float("inf")])
def test_impossible_scale_is_refused(scale: float):
    with pytest.raises(ObjectError, match="give a positive number"):
        load_object("mug", scale=scale)


@pytest.mark.usefixtures("without_assets")
def test_unknown_name_lists_near_ones():
    with pytest.raises(ObjectError, match=r"no object is called 'botle'. Perhaps you meant bottle") as caught:
        load_object("botle")
    assert "dro-grasp objects" in str(caught.value)
    assert len(str(caught.value)) < 500


@pytest.mark.usefixtures("without_assets")
def test_names_without_assets_are_the_builtins():
    assert object_names() == {name: kind.split for name, kind in BUILTIN.items()}
    with pytest.raises(ObjectError, match="no object is called 'assets/mug'"):
        load_object("assets/mug")


def test_folder_stands_for_its_files(tmp_path: Path):
    for name in ("b.stl", "a.obj", "notes.txt"):
        (tmp_path / name).touch()
    assert resolve_objects(["mug", str(tmp_path)]) == ["mug", str(tmp_path / "a.obj"), str(tmp_path / "b.stl")]
    with pytest.raises(ObjectError, match="is a folder"):
        load_object(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ObjectError, match="holds no mesh or point cloud"):
        resolve_objects([str(tmp_path / "empty")])


def test_path_of_a_mesh(tmp_path: Path):
    trimesh.creation.box((0.05, 0.05, 0.05)).export(tmp_path / "block.stl")
    assert load_object(tmp_path / "block.stl").split is None
    assert load_object(str(tmp_path / "block.stl"), scale=2).extents[0] == pytest.approx(0.1)


def test_asset_with_its_parts_and_split(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("DRO_GRASP_ASSETS", str(small_assets(tmp_path)))
    obj = load_object("assets/set+cross", scale=2)
    assert obj.name == "set+cross"
    assert obj.split == "train"
    assert [np.ptp(v, axis=0).round(6).max() for v, _ in obj.parts] == [0.08, 0.16]
    plain = load_object("set+plain")
    assert plain.exact_parts is None
    assert plain.split is None
    assert object_names()["set+gone"] == "validate"
    assert object_names()["set+plain"] == "extra"
    with pytest.raises(ObjectError, match=r"names .*gone\.obj, which does not exist"):
        load_object("set+gone")


def test_damaged_manifest_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "objects").mkdir()
    (tmp_path / "objects" / "manifest.json").write_text("[{]")
    monkeypatch.setenv("DRO_GRASP_ASSETS", str(tmp_path))
    with pytest.raises(ObjectError, match=r"manifest\.json is no list of objects"):
        object_names()


@pytest.mark.assets
def test_splits_of_the_assets(assets_folder: Path):
    assert os.environ["DRO_GRASP_ASSETS"] == str(assets_folder)
    splits = [split for name, split in object_names().items() if name not in BUILTIN]
    assert (splits.count("train"), splits.count("validate")) == (48, 10)


@pytest.mark.assets
@pytest.mark.parametrize("name", ["contactdb+apple", "contactdb+airplane", "ycb+bleach_cleanser"])
def test_assets_load_with_parts_that_fill_them(assets_folder: Path, name: str):
    obj = load_object(name)
    entry = next(e for e in json.loads((assets_folder / "objects/manifest.json").read_text()) if e["name"] == name)
    assert obj.volume == pytest.approx(entry["volume_m3"], rel=0.01)
    np.testing.assert_allclose(obj.extents, entry["extents_m"], atol=2e-4)
    hulls = sum(trimesh.convex.convex_hull(vertices).volume for vertices, _ in obj.parts)
    assert hulls == pytest.approx(obj.volume, rel=0.25)
    assert obj.cloud.shape == obj.cloud_normals.shape == (16384, 3)


def test_groups_stand_for_their_members(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, without_assets: None):
    test = resolve_objects(["builtin:test", "mug"])
    assert test == [*sorted(n for n, kind in BUILTIN.items() if kind.split == "test"), "mug"]
    with pytest.raises(ObjectError, match="no object is in 'assets:train'; set DRO_GRASP_ASSETS"):
        resolve_objects(["assets:train"])
    monkeypatch.setenv("DRO_GRASP_ASSETS", str(small_assets(tmp_path)))
    splits = {name: split for name, split in object_names().items() if name not in BUILTIN}
    for split in set(splits.values()):
        assert resolve_objects([f"assets:{split}"]) == sorted(n for n, s in splits.items() if s == split)
    with pytest.raises(ObjectError, match="no object is in 'builtin:nonsense'"):
        resolve_objects(["builtin:nonsense"])


@pytest.fixture
def clone(tmp_path):
    return clone_of_bars(tmp_path, ("b", "a"))


def test_objects_have_the_benchmarks_parts_at_the_scale(clone):
    folders = processed_objects(clone)
    assert [folder.name for folder in folders] == ["a", "b"]
    obj = load_object(folders[0], scale=0.06)
    assert obj.name == "a@0.06"
    np.testing.assert_allclose(obj.extents, [0.12, 0.06, 0.06])
    assert [sorted(np.ptp(vertices, axis=0)) for vertices, _ in obj.parts] == [[pytest.approx(0.06)] * 3] * 2
    assert [np.mean(vertices, 0)[0] for vertices, _ in obj.parts] == pytest.approx([-0.03, 0.03])
    assert resolve_objects([str(folders[0])]) == [str(folders[0])]


def test_what_it_says_it_was_loaded_from_is_the_same_object(clone):
    obj = load_object(processed_objects(clone)[1], scale=0.1)
    again = load_object(obj.file, scale=obj.scale)
    assert (again.name, again.sha256, len(again.parts)) == (obj.name, obj.sha256, 2)


def test_a_folder_without_any_is_told(clone):
    with pytest.raises(ObjectError, match="holds no object of DexGraspBench"):
        processed_objects(clone / "assets" / "empty")
    with pytest.raises(ObjectError, match="is a folder"):
        load_object(clone / "assets" / "empty")
