"""`dro-grasp generate --scene`: one thing of what a camera saw. Weights are untrained throughout."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dro_grasp import extras
from dro_grasp.cli.main import main
from dro_grasp.errors import ObjectError
from dro_grasp.grasps.batch import load_grasps
from dro_grasp.grasps.sources import frame_of, object_of
from dro_grasp.objects import scenery
from dro_grasp.objects.catalogue import load_object
from dro_grasp.predict.predictor import GraspPredictor
from tests.helpers.made_scenes import MadeScene, make_scene


@pytest.fixture(scope="module")
def made() -> MadeScene:
    return make_scene("table", 4, 15, 1, width=320)


@pytest.fixture(scope="module")
def common(made: MadeScene, weights: str, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("scene")
    Image.fromarray(np.nan_to_num(1000 * made.depth).round().astype(np.uint16)).save(folder / "depth.png")
    (folder / "camera.json").write_text(json.dumps({
        "frame": "base", "T_frame_camera": made.camera.T_frame_camera.tolist(),
        "intrinsics": np.asarray(made.camera.intrinsics).tolist()}))
    return ["generate", "--hand", "gripper3", "--weights", weights, "--num", "2", "--candidates", "4", "--source", "network",
            "--no-refine", "--scene", str(folder / "depth.png"), "--camera", str(folder / "camera.json")]


def test_grasps_lie_at_the_thing_that_is_meant(common: list[str], made: MadeScene, tmp_path: Path, capsys) -> None:
    place = [f"{value:.3f}" for value in made.middles[1]]
    files = ["--output", str(tmp_path / "g.parquet"), "--scene-picture", str(tmp_path / "s.png")]
    assert main([*common, "--at", *place, *files, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["frame"] == "base"
    grasps = load_grasps(tmp_path / "g.parquet")
    assert frame_of(grasps) == "base"
    assert (np.linalg.norm(grasps.wrist_position.numpy() - made.middles[1], axis=1) < 0.35).all()
    obj = object_of(grasps, None, 1.0)
    assert {obj.sha256} == set(grasps.object_sha256)
    assert obj.seen is not None
    assert obj.table is not None
    np.testing.assert_allclose(np.linalg.norm(obj.cloud_normals, axis=1), 1, atol=1e-3)
    assert (np.linalg.norm((obj.cloud.min(0) + obj.cloud.max(0)) / 2 - made.middles[1])) < 0.03
    assert main(["export", str(tmp_path / "g.parquet"), "--format", "csv", "--output", str(tmp_path / "g.csv")]) == 0
    damaged = grasps.replace(extra=grasps.extra | {"object_cloud": ("AAAA",) * len(grasps)})
    with pytest.raises(ObjectError, match="in the grasp file is damaged"):
        object_of(damaged, None, 1.0)
    with Image.open(tmp_path / "s.png") as picture:
        assert picture.size[0] > 1000


def test_where_it_is_not_clear_which_is_meant_the_picture_is_drawn_all_the_same(
    common: list[str], tmp_path: Path, capsys
) -> None:
    assert main([*common, "--scene-picture", str(tmp_path / "s.png")]) == 2
    told = capsys.readouterr().err
    assert "shows 4 things" in told
    assert "--at X Y Z" in told
    assert "--nearest" in told
    assert (tmp_path / "s.png").is_file()


@pytest.mark.parametrize(("more", "told"), [
    (["--at", "0", "0", "0", "--nearest"], "--at and --nearest each say which thing"),
    (["--object", "mug"], "both are given"),
])
def test_what_contradicts_a_scene_is_refused(common: list[str], more: list[str], told: str, capsys) -> None:
    assert main([*common, *more]) == 2
    assert told in " ".join(capsys.readouterr().err.split())


def test_options_of_a_scene_need_one(weights: str, capsys) -> None:
    assert main(["generate", "--hand", "gripper3", "--object", "mug", "--weights", weights, "--nearest"]) == 2
    assert "--nearest concerns a scene" in " ".join(capsys.readouterr().err.split())
    assert main(["generate", "--hand", "gripper3", "--object", "mug", "--weights", weights, "--nearest", "--part"]) == 2
    assert "--nearest and --part concern a scene" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("suffix", ["png", "tiff", "npy"])
@pytest.mark.parametrize("seen", [False, True])
def test_a_depth_image_given_as_an_object_is_told_to_be_a_scene(
    weights: str, seen: bool, suffix: str, tmp_path: Path, capsys
) -> None:
    path, camera = tmp_path / f"depth.{suffix}", tmp_path / "camera.json"
    depth = np.full((60, 80), 700, np.uint16)
    np.save(path, depth) if suffix == "npy" else Image.fromarray(depth).save(path)
    camera.write_text(json.dumps({"frame": "base", "T_frame_camera": np.diag([1.0, -1, -1, 1]).tolist()}))
    more = ["--camera", str(camera)] if seen else []
    assert main(["generate", "--hand", "gripper3", "--object", str(path), "--weights", weights, *more]) == 2
    told = " ".join(capsys.readouterr().err.split())
    assert "If it is a depth image, give it as a scene" in told
    assert "--scene FILE --camera JSON" in told
    assert "--pixel U V" in told
    assert "states the intrinsics" in told
    with pytest.raises(ObjectError, match=r"If it is a depth image, .*load_scene and object_at in Python"):
        load_object(path)

@pytest.mark.parametrize(("more", "told"), [
    (["--protocol", "carry"], "--protocol carry asks for a trial in simulation, and a thing of a scene is a bare point cloud"),
    (["--only-successful"], "--only-successful asks for a trial in simulation, and a thing of a scene is a bare point cloud"),
    (["--keep-table"], "the table of a scene is found in any case"),
    (["--protocol", "carry", "--only-successful"],
     "leave out --protocol carry and --only-successful, or give the object's mesh with --object and leave out --scene and "
     "--camera"),
])
def test_what_no_scene_can_do_is_refused_before_it_is_read(
    common: list[str], more: list[str], told: str, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    def none(*_: object, **__: object) -> None:
        raise AssertionError("the scene is read")

    monkeypatch.setattr(scenery, "load_scene", none)
    assert main([*common, "--nearest", *more]) == 2
    assert told in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("more", [["--protocol", "carry"], ["--only-successful"]])
@pytest.mark.parametrize("seen", [False, True])
def test_trials_of_clouds_are_refused_before_grasps_are_predicted(
    common: list[str], made: MadeScene, seen: bool, more: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    def none(*_: object, **__: object) -> None:
        raise AssertionError("grasps are predicted")

    monkeypatch.setattr(GraspPredictor, "run_many", none)
    np.save(tmp_path / "points.npy", load_object("sphere").cloud + np.array([0, 0, 0.5 * seen]))
    start, camera = common[:common.index("--scene")], common[common.index("--camera"):] if seen else []
    assert main([*start, "--object", str(tmp_path / "points.npy"), *camera, *more]) == 2
    told = " ".join(capsys.readouterr().err.split())
    assert "bare point cloud" in told or "'points' gets none" in told


def test_successful_grasps_alone_need_a_trial(weights: str, capsys) -> None:
    assert main(["generate", "--hand", "gripper3", "--object", "mug", "--weights", weights, "--only-successful", "--protocol",
                 "none"]) == 2
    assert "--protocol none asks for none" in " ".join(capsys.readouterr().err.split())


def test_a_page_that_cannot_be_shown_is_refused_before_the_work(
    weights: str, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    def none(*_: object, **__: object) -> None:
        raise AssertionError("grasps are predicted")

    monkeypatch.setattr(GraspPredictor, "run_many", none)
    monkeypatch.setitem(extras.EXTRAS, "apps", ("no_such_package",))
    assert main(["generate", "--hand", "gripper3", "--object", "mug", "--weights", weights, "--view"]) == 2
    assert "no_such_package" in capsys.readouterr().err
    assert main(["generate", "--hand", "gripper3", "--object", "mug", "--view", "--server", "http://127.0.0.1:9"]) == 2
    assert "a grasp server cannot do --view" in capsys.readouterr().err, "the extra would not help"


def test_a_trial_of_what_a_camera_sees_needs_a_mesh_without_the_camera(weights: str, capsys) -> None:
    assert main(["generate", "--hand", "gripper3", "--weights", weights, "--object", "c.npy", "--camera", "c.json",
                 "--protocol", "carry"]) == 2
    assert "leave out --protocol carry, or give the object's mesh with --object and leave out --camera" in " ".join(
        capsys.readouterr().err.split())
