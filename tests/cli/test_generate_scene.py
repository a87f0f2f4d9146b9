"""`dro-grasp generate --scene`: one thing of what a camera saw. Weights are untrained throughout."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dro_grasp.cli.main import main
from dro_grasp.errors import ObjectError
from dro_grasp.grasps.batch import load_grasps
from dro_grasp.grasps.sources import frame_of, object_of
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
    return ["generate", "--hand", "gripper3", "--weights", weights, "--num", "2", "--candidates", "1", "--source", "network",
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
    assert "--nearest concern a scene" in " ".join(capsys.readouterr().err.split())
