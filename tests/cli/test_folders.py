"""Folders of grasp files, as `generate` fills them for a folder of objects: every command that reads grasps takes them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from dro_grasp.apps.viewer.studio import StudioServer
from dro_grasp.cli.generate import paths_per_object
from dro_grasp.cli.main import main, parse
from dro_grasp.errors import GraspFileError, NoGraspError
from dro_grasp.grasps.batch import GraspBatch, load_grasps
from dro_grasp.grasps.sources import object_file, object_of, with_own_files
from dro_grasp.objects.catalogue import load_object
from dro_grasp.pictures.sheets import CAPTION, HEADER, TILE
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.controls import palm_facing_starts
from dro_grasp.training.data.collections import checking, filtering
from tests.helpers.browser import free_port
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.served_studio import visited


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Grasps of two objects by one hand, a file each, and a file of no grasp."""
    place = tmp_path_factory.mktemp("grasps")
    hand = loaded_hand("gripper3")
    for name, num in (("sphere", 3), ("can", 2)):
        obj = load_object(name)
        starts = palm_facing_starts(hand, obj, num=num, seed=0)
        starts.save(place / f"{name}.parquet")
    starts[:0].save(place / "nothing.parquet")
    return place


def test_a_folder_may_be_named_from_home(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(folder.parent))
    assert len(load_grasps(f"~/{folder.name}")) == 5


def test_evaluate_takes_a_folder(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", str(folder), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["num"] == 5
    assert {name: entry["num"] for name, entry in told["objects"].items()} == {"sphere": 3, "can": 2}


def test_export_takes_a_folder(folder: Path, tmp_path: Path) -> None:
    assert main(["export", str(folder), "--format", "csv", "--output", str(tmp_path / "out")]) == 0
    rows = {path.name: sum(not line.startswith("#") for line in path.read_text().splitlines()) - 1
            for path in (tmp_path / "out").iterdir()}
    assert rows == {"sphere.csv": 3, "can.csv": 2}


def test_objects_whose_names_look_alike_as_files_keep_a_file_each(folder: Path, tmp_path: Path) -> None:
    grasps = load_grasps(folder / "sphere.parquet")
    grasps = grasps.replace(pregrasp_joints=grasps.joints, squeeze_joints=grasps.joints)
    alike = GraspBatch.concatenate([grasps.replace(object=(name,) * 3, object_sha256=(name,) * 3) for name in ("a/b", "a-b")])
    alike.save(tmp_path / "alike.parquet")
    assert main(["export", str(tmp_path / "alike.parquet"), "--format", "csv", "--output", str(tmp_path / "out")]) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a-b-2.csv", "a-b.csv"]


@pytest.mark.parametrize(("more", "tiles"), [([], (4, 2)), (["--count", "2"], (2, 1)), (["--object", "can"], (2, 1))])
def test_picture_takes_a_folder(folder: Path, tmp_path: Path, more: list[str], tiles: tuple[int, int]) -> None:
    path = tmp_path / "sheet.png"
    assert main(["picture", str(folder), "--output", str(path), *more]) == 0
    with Image.open(path) as picture:
        assert picture.size == (tiles[0] * TILE[0], HEADER + tiles[1] * (TILE[1] + CAPTION))


@pytest.mark.filterwarnings("default::DeprecationWarning", "default::ResourceWarning")
def test_view_takes_a_folder(folder: Path) -> None:
    servers: list[StudioServer] = []
    for more in ([], ["--object", "sphere"]):
        assert parse(["view", str(folder), "--port", str(free_port()), *more]).run(servers.append) == 0
    try:
        for server in servers:
            visited(server, 1)
        first, second = (server.studios[0] for server in servers)
        assert (first.made.obj.name, len(first.made.refined)) == ("can", 2)
        assert (second.made.obj.name, len(second.made.refined)) == ("sphere", 3)
        assert {"can", "sphere"} <= set(first.object.options)
        assert first.hand.value == "gripper3"
        first.object.value = "sphere"
        first._pick_object()
        assert len(first.made.refined) == 3, "the other object's grasps can be picked"
        assert "not evaluated" in first.status.content
    finally:
        for server in servers:
            server.stop()


def test_objects_of_the_same_name_are_told_apart(tmp_path: Path) -> None:
    hand, expected = loaded_hand("gripper3"), {}
    for kind, side in (("obj", 0.05), ("ply", 0.06)):
        trimesh.creation.box((side, side, 0.08)).export(tmp_path / f"box.{kind}")
        obj = load_object(tmp_path / f"box.{kind}")
        with_own_files(palm_facing_starts(hand, obj, num=1, seed=0), hand, obj).save(tmp_path / f"box_{kind}.parquet")
        expected[f"box_{kind}"] = obj.sha256
    grasps = load_grasps(tmp_path)
    assert dict(zip(grasps.object, grasps.object_sha256, strict=True)) == expected
    assert main(["evaluate", str(tmp_path)]) == 0


def test_one_built_in_object_of_two_sizes_is_evaluated_from_a_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hand = loaded_hand("gripper3")
    for scale in (1.0, 0.8):
        obj = load_object("brick", scale=scale)
        with_own_files(palm_facing_starts(hand, obj, num=1, seed=0), hand, obj).save(tmp_path / f"scale_{scale:g}.parquet")
    assert main(["evaluate", str(tmp_path), "--json"]) == 0
    said = capsys.readouterr()
    assert "were made for another" not in said.err
    assert set(json.loads(said.out)["objects"]) == {"scale_1", "scale_0.8"}


def test_a_file_of_an_objects_name_in_the_folder_is_not_taken_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    mesh = trimesh.creation.box((0.05, 0.05, 0.08))
    (tmp_path / "brick").write_text("notes")
    (tmp_path / "mesh").write_text("notes")
    hand = loaded_hand("gripper3")
    for obj in (load_object("brick"), load_object(mesh)):
        assert obj.name in {"brick", "mesh"}
        grasps = with_own_files(palm_facing_starts(hand, obj, num=1, seed=0), hand, obj)
        assert "object_file" not in grasps.extra
    assert object_file("brick") is None


def test_objects_of_one_name_in_one_file_are_told_apart_by_every_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hand, batches, objects = loaded_hand("gripper3"), [], []
    for folder, side, num in (("003", 0.05, 1), ("004", 0.06, 2)):
        (tmp_path / folder).mkdir()
        trimesh.creation.box((side, side, 0.08)).export(tmp_path / folder / "textured.obj")
        obj = load_object(tmp_path / folder / "textured.obj")
        batches.append(with_own_files(palm_facing_starts(hand, obj, num=num, seed=0), hand, obj))
        objects.append(obj)
    file = tmp_path / "both.parquet"
    GraspBatch.concatenate(batches).save(file)
    assert main(["evaluate", str(file), "--json"]) == 0
    said = capsys.readouterr()
    assert "were made for another" not in said.err
    assert {name: entry["num"] for name, entry in json.loads(said.out)["objects"].items()} == {"textured": 1, "textured (2)": 2}
    assert main(["export", str(file), "--format", "csv", "--output", str(tmp_path / "out")]) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["textured (2).csv", "textured.csv"]
    for more, drawn in (([], objects), (["--object", "textured (2)"], objects[1:])):
        pairs = parse(["picture", str(file), "--output", "sheet.png", *more]).pairs(load_grasps(file))
        assert [obj.sha256 for obj, _ in pairs] == [obj.sha256 for obj in drawn]
        assert [len(own) for _, own in pairs] == [1, 2][-len(drawn):]
    parts = dict(GraspBatch.load(file).by_object())
    assert [object_of(parts[name], None, 1.0).sha256 for name in ("textured", "textured (2)")] == [o.sha256 for o in objects]


@pytest.fixture
def beside_a_cloud(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file of grasps of a can and of a bare cloud."""
    monkeypatch.chdir(tmp_path)
    np.save("points.npy", load_object("sphere").cloud)
    hand, points = loaded_hand("gripper3"), load_object("points.npy")
    batches = [palm_facing_starts(hand, obj, num=n, seed=0) for obj, n in ((points, 2), (load_object("can"), 1))]
    GraspBatch.concatenate([with_own_files(batches[0], hand, points), batches[1]]).save("both.parquet")
    return tmp_path / "both.parquet"


def test_evaluate_leaves_grasps_of_bare_clouds_as_they_are(
    beside_a_cloud: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tried, asked = tmp_path / "tried.parquet", ["--contact-quality", "--json"]
    assert main(["evaluate", str(beside_a_cloud), "--output", str(tried), *asked]) == 0
    told = capsys.readouterr()
    assert "points: a bare point cloud has no trial; its 2 grasps" in told.err
    report = json.loads(told.out)
    assert (report["num"], list(report["objects"]), report["bare_clouds"]) == (1, ["can"], ["points"])
    outcomes = GraspBatch.load(tried)
    assert dict(zip(outcomes.object, outcomes.evaluated.tolist(), strict=True)) == {"can": True, "points": False}
    assert len(outcomes) == 3
    given = GraspBatch.load(beside_a_cloud)
    left = torch.tensor([name == "points" for name in given.object])
    torch.testing.assert_close(outcomes[~outcomes.evaluated].T_object_wrist, given[left].T_object_wrist)
    given[left].save(beside_a_cloud)
    assert main(["evaluate", str(beside_a_cloud)]) == 2
    assert "object 'points' is a bare point cloud; a trial needs a mesh" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["check", "filter --output kept"])
def test_a_bare_cloud_among_the_objects_is_refused_before_any_trial(
    command: str, beside_a_cloud: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def none(*_: object, **__: object) -> None:
        raise AssertionError("a trial")

    for module in (checking, filtering):
        monkeypatch.setattr(module, "simulate", none)
    grasps = GraspBatch.load(beside_a_cloud)
    grasps.replace(protocol=("carry/1",) * len(grasps)).save(beside_a_cloud)
    assert main(["dataset", *command.split(), str(beside_a_cloud)]) == 2
    assert "object 'points' is a bare point cloud; a trial needs a mesh" in capsys.readouterr().err


def test_folders_of_several_hands_or_of_no_grasp_are_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(GraspFileError, match="no grasp file"):
        load_grasps(tmp_path)
    for hand in ("barrett", "gripper3"):
        starts = palm_facing_starts(loaded_hand(hand), load_object("can"), num=1, seed=0)
        starts[:0].save(tmp_path / f"{hand}.parquet")
    with pytest.raises(GraspFileError, match="only grasp files without any grasp"):
        load_grasps(tmp_path)
    for hand in ("barrett", "gripper3"):
        palm_facing_starts(loaded_hand(hand), load_object("can"), num=1, seed=0).save(tmp_path / f"{hand}.parquet")
    with pytest.raises(GraspFileError, match=r"t\.parquet has grasps of hand 'barrett', .*3\.parquet of 'gripper3'"):
        load_grasps(tmp_path)
    with pytest.raises(GraspFileError, match="no grasp file"):
        load_grasps(tmp_path / "nowhere.parquet")


def test_results_of_objects_whose_names_look_alike_keep_a_file_each(tmp_path: Path) -> None:
    names = ["a/mug.obj", "a/mug.ply", "a/mug_obj.stl", "b/can.stl"]
    files = paths_per_object(tmp_path, names, True, ".parquet")
    assert [file.name for file in files if file is not None] == [
        "mug_obj.parquet", "mug_ply.parquet", "mug_obj-2.parquet", "can.parquet"]


def test_an_object_without_any_grasp_counts_in_later_rates(
    tmp_path: Path, weights: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    honest = GraspPredictor.run_many

    def run_many(self: GraspPredictor, problems: list[GraspProblem], *others: object) -> list[object]:
        nothing = NoGraspError("none is trusted")
        return [nothing if problems[0].obj.name == "large" else made for made in honest(self, problems, *others)]

    monkeypatch.setattr(GraspPredictor, "run_many", run_many)
    for name, size in (("small", 0.03), ("large", 0.04)):
        trimesh.creation.box((size, size, 0.1)).export(tmp_path / f"{name}.stl")
    (tmp_path / "in").mkdir()
    for name in ("small", "large"):
        (tmp_path / f"{name}.stl").rename(tmp_path / "in" / f"{name}.stl")
    output = tmp_path / "out"
    quickly = ["--source", "network", "--candidates", "1", "--no-refine", "--protocol", "none"]
    assert main(["generate", "--hand", "gripper3", "--object", str(tmp_path / "in"), "--weights", weights, "--num", "2",
                 *quickly, "--output", str(output)]) == 2
    assert {file.name for file in output.iterdir()} == {"small.parquet", "large.parquet"}
    capsys.readouterr()
    assert main(["evaluate", str(output), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["asked"], told["num"]) == (4, 2)
