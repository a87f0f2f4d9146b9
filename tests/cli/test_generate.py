"""`dro-grasp generate`: what it reports, saves and refuses. Weights are untrained throughout."""

from __future__ import annotations

import dataclasses
import io
import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from rich.console import Console

from dro_grasp.cli import generate as generating, output
from dro_grasp.cli.main import main, parse
from dro_grasp.compare.metrics import wilson_interval
from dro_grasp.errors import NoGraspError, ObjectError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands import library
from dro_grasp.objects import catalogue
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimize.synthesis import SynthesisConfig, synthesize
from dro_grasp.predict.admission import feasible
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.predictor import GraspPredictor, Prediction
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.controls import palm_facing_starts
from dro_grasp.predict.stages import refine
from dro_grasp.simulation.trial import simulate
from tests.helpers.fake_device import DEVICE, fake_device
from tests.helpers.loaded_hands import loaded_hand

KEYS = {
    "hand", "object", "num", "candidates", "origin", "origins", "seed", "weights", "protocol", "success", "success_rate",
    "seconds", "output", "frame",
}


def test_saving_the_successful_without_a_trial_is_refused(weights: str, tmp_path: Path, capsys) -> None:
    np.save(tmp_path / "cloud.npy", np.random.default_rng(0).normal(size=(500, 3)) * 0.02)
    common = ["generate", "--hand", "gripper3", "--weights", weights, "--only-successful"]
    common += ["--output", str(tmp_path / "a.parquet")]
    for more in (["--object", "sphere", "--protocol", "none"], ["--object", str(tmp_path / "cloud.npy")]):
        assert main([*common, *more]) == 2
        assert "name a --protocol" in capsys.readouterr().err
    assert not (tmp_path / "a.parquet").exists()


def test_a_terminal_shows_at_once_what_is_done(weights: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before a library, the hand or the object is loaded, and through all of it."""
    monkeypatch.setattr(output, "stderr", Console(file=(shown := io.StringIO()), force_terminal=True, width=120))
    seen: dict[str, str] = {}
    hand = loaded_hand("gripper3")
    monkeypatch.setattr(library, "load_hand", lambda name: seen.setdefault("hand", shown.getvalue()) and hand)
    monkeypatch.setattr(catalogue, "load_object", lambda name, **more: seen.setdefault("object", shown.getvalue()) and refuse())
    assert main(["generate", "--hand", "gripper3", "--object", "sphere", "--weights", weights]) == 2
    assert "loading libraries, hand and weights" in seen["hand"]
    assert "reading sphere" in seen["object"]
    assert "reading" not in seen["hand"]


def refuse() -> None:
    raise ObjectError("enough")


def test_outputs_are_checked_before_the_work(capsys) -> None:
    """Before the hand is loaded, which does not exist either."""
    assert main(["generate", "--hand", "no_hand", "--object", "sphere", "--output", "nowhere/a.parquet"]) == 2
    said = capsys.readouterr().err
    assert "nowhere" in said
    assert "no_hand" not in said


def test_options_that_would_do_nothing_or_replace_one_another_are_refused(capsys) -> None:
    base = ["generate", "--hand", "gripper3", "--object", "can"]
    assert main([*base, "--margin", "2", "--max-force", "5", "--no-refine"]) == 2
    assert "--margin and --max-force say how hands squeeze once they settle, and with --no-refine" in capsys.readouterr().err
    assert main([*base[:3], "--scene", "c.ply", "--scene-picture", "a.png", "--picture", "./a.png"]) == 2
    assert "named twice, and one file would replace the other" in capsys.readouterr().err
    assert main(["benchmark", "--hands", "gripper3", "--objects", "can", "--max-force", "5"]) == 2
    assert "--max-force says how hands squeeze" in capsys.readouterr().err


def test_a_source_that_does_not_exist_is_told_before_the_work(capsys) -> None:
    base = ["generate", "--hand", "no_hand", "--object", "sphere", "--source"]
    for source, told in (("magic", "there is no source 'magic'"), ("nowhere.parquet", "nowhere.parquet"),
                         ("no_module:Mine", "cannot be imported")):
        assert main([*base, source]) == 2
        said = capsys.readouterr().err
        assert told in said
        assert "no_hand" not in said


def test_what_grasps_carry_is_told(
    generate, weights: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run_many = GraspPredictor.run_many

    def carrying(*arguments: Any) -> list[Prediction]:
        made, = run_many(*arguments)
        assert isinstance(made, Prediction)
        payload, force = torch.tensor([0.8, torch.nan, 0.034]), torch.tensor([6.25, 31.0, torch.nan])
        return [dataclasses.replace(made, grasps=made.grasps.replace(payload=payload, squeeze_force=force))]

    monkeypatch.setattr(GraspPredictor, "run_many", carrying)
    report = generate("--protocol", "none")
    assert (report["payload"], report["squeeze_force"]) == (pytest.approx([0.8, None, 0.034]), [6.25, 31.0, None])
    assert main(["generate", "--hand", "gripper3", "--object", "sphere", "--weights", weights, "--num", "3", "--source",
                 "network", "--candidates", "1", "--protocol", "none"]) == 0
    said = capsys.readouterr().out
    assert "they carry 0.034 to 0.8 kg, squeeze with 6.2 to 31 N" in said
    assert "carries [kg]" in said


def test_generate_reports_and_saves_what_it_counts(generate, tmp_path: Path) -> None:
    path = tmp_path / "grasps.parquet"
    report = generate("--output", str(path), source="auto", candidates=4)
    assert report.keys() >= KEYS
    assert set(report["seconds"]) == {
        "start", "load", "network", "choose", "decode", "optimiser", "refine", "settle", "rank", "weigh", "ease", "trial",
        "files", "total"}
    parts = sum(value for name, value in report["seconds"].items() if name != "total")
    assert 0.8 * report["seconds"]["total"] < parts <= report["seconds"]["total"] + 0.01
    assert (report["num"], report["protocol"]) == (3, "carry")
    assert report["candidates"] >= 8  # the fewest of the network, and those of the optimiser
    assert report["success_rate"] == pytest.approx(report["success"] / 3)
    grasps = GraspBatch.load(path)
    assert len(grasps) == 3
    assert int(grasps.success.sum()) == report["success"]
    assert (grasps.score[:-1] >= grasps.score[1:]).all()
    assert "predicted_points" not in grasps.extra
    assert report["origins"] == ["network" if maker.startswith("network") else "optimiser" for maker in grasps.provenance]
    assert report["origin"] == Counter(report["origins"])


def test_same_seed_same_grasps(generate, tmp_path: Path) -> None:
    files = [tmp_path / f"{i}.parquet" for i in range(3)]
    for file, seed in zip(files, (5, 5, 6), strict=True):
        generate("--output", str(file), "--seed", str(seed), "--protocol", "none")
    first, again, other = (GraspBatch.load(f).joints for f in files)
    assert (first == again).all()
    assert not (first == other).all()


def test_only_successful_filters_the_file_never_the_rate(generate, tmp_path: Path) -> None:
    path = tmp_path / "grasps.parquet"
    report = generate("--output", str(path), "--only-successful", num=6)
    assert report["num"] == 6
    assert report["success_rate"] == pytest.approx(report["success"] / 6)
    assert len(GraspBatch.load(path)) == report["success"]


def test_bare_cloud_is_not_tried(generate, tmp_path: Path) -> None:
    directions = np.random.default_rng(0).normal(size=(3000, 3))
    np.save(tmp_path / "cloud.npy", 0.03 * directions / np.linalg.norm(directions, axis=1, keepdims=True))
    report = generate(name=str(tmp_path / "cloud.npy"))
    assert (report["protocol"], report["success"], report["success_rate"]) == ("none", None, None)


def test_folder_of_objects_gets_a_file_each(generate, tmp_path: Path) -> None:
    """In a folder that is there, or is made."""
    objects, results = tmp_path / "objects", tmp_path / "new" / "results"
    objects.mkdir()
    trimesh.creation.icosphere(radius=0.03).export(objects / "a.stl")
    trimesh.creation.icosphere(radius=0.03).export(objects / "a.ply")
    report = generate("--output", str(results), "--protocol", "none", name=str(objects))
    assert [r["num"] for r in report["results"]] == [3, 3]
    assert sorted(f.name for f in results.iterdir()) == ["a_ply.parquet", "a_stl.parquet"]


def test_a_bad_object_in_a_folder_costs_only_its_own_grasps(
    weights: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    objects, results = tmp_path / "objects", tmp_path / "results"
    objects.mkdir(), results.mkdir()
    trimesh.creation.icosphere(radius=0.03).export(objects / "a.stl")
    trimesh.creation.icosphere(radius=30.0).export(objects / "huge.stl")
    trimesh.creation.box((0.05, 0.05, 0.05)).export(objects / "z.stl")
    base = ["generate", "--hand", "gripper3", "--object", str(objects), "--weights", weights, "--num", "2"]
    assert main([*base, "--source", "network", "--protocol", "none", "--output", str(results), "--json"]) == 2
    said = capsys.readouterr()
    report = json.loads(said.out)
    assert [r["object"] for r in report["results"]] == ["a", "z"]
    (failed,) = report["failed"]
    assert failed["object"].endswith("huge.stl")
    assert "too large" in failed["error"]
    assert "huge.stl" in said.err
    assert sorted(f.name for f in results.iterdir()) == ["a.parquet", "z.parquet"]


def test_a_device_predicts_the_objects_of_a_folder_together(
    weights: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As many at once as suits it, the last part smaller; a file that is no object costs only its own grasps."""
    folder, together, run_many = tmp_path / "objects", [], GraspPredictor.run_many
    folder.mkdir()
    for i, side in enumerate((0.04, 0.05, 0.06, 0.045)):
        trimesh.creation.box((side, side, 0.08)).export(folder / f"box{i}.ply")
    (folder / "box2.ply").write_text("no mesh")

    def watched(self: GraspPredictor, problems: list[GraspProblem], *given: Any) -> list[Prediction | NoGraspError]:
        together.append([problem.obj.name for problem in problems])
        return run_many(self, problems, *given)

    monkeypatch.setattr(GraspPredictor, "run_many", watched)
    command = ["generate", "--hand", "gripper3", "--object", str(folder), "--weights", weights, "--num", "2",
               "--candidates", "1", "--source", "network", "--no-refine", "--protocol", "none", "--json", "--device"]
    assert [len(part) for part in parse([*command, DEVICE])._parts(list(range(130)))] == [64, 64, 2]
    monkeypatch.setattr(generating, "TOGETHER", 3)
    found = []
    for device in ("cpu", DEVICE):
        (output := tmp_path / device).mkdir()
        with fake_device():
            assert main([*command, device, "--output", str(output)]) == 2
        assert "box2" in capsys.readouterr().err
        found.append([GraspBatch.load(output / f"box{i}.parquet") for i in (0, 1, 3)])
    assert together == [["box0"], ["box1"], ["box3"], ["box0", "box1"], ["box3"]]
    for one, other in zip(*found, strict=True):
        assert (one.object, len(one)) == (other.object, 2)
        torch.testing.assert_close(other.joints, one.joints, atol=1e-3, rtol=0.0)
        torch.testing.assert_close(other.T_object_wrist, one.T_object_wrist, atol=1e-3, rtol=0.0)


def test_a_bad_camera_file_is_refused_once_for_all_objects(weights: str, tmp_path: Path, capsys) -> None:
    for name in ("a.npy", "b.npy"):
        np.save(tmp_path / name, np.zeros((3, 3)))
    base = ["generate", "--hand", "gripper3", "--object", str(tmp_path), "--weights", weights]
    assert main([*base, "--camera", str(tmp_path / "nowhere.json"), "--json"]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("error: ")
    assert said.err.count("nowhere.json must hold") == 1


def test_folder_of_objects_needs_a_folder_for_results(weights: str, tmp_path: Path, capsys) -> None:
    (tmp_path / "a.stl").write_text("")
    (tmp_path / "b.stl").write_text("")
    base = ["generate", "--hand", "gripper3", "--object", str(tmp_path), "--weights", weights]
    for option, name in (("--output", "all.parquet"), ("--picture", "all.png")):
        assert main([*base, option, str(tmp_path / name)]) == 2
        assert f"{name} is the name of a file; for 2 objects give that of a folder" in capsys.readouterr().err
    assert main([*base, "--output", str(tmp_path / "a.stl")]) == 2
    assert "a.stl" in capsys.readouterr().err
    new = str(tmp_path / "new")
    assert main([*base, "--output", new, "--picture", str(tmp_path / "all.png")]) == 2
    assert main([*base, "--output", new, "--camera", str(tmp_path / "nowhere.json")]) == 2
    assert sorted(each.name for each in tmp_path.iterdir()) == ["a.stl", "b.stl"]


def test_table_keeps_hands_above_it(generate, tmp_path: Path) -> None:
    path = tmp_path / "grasps.parquet"
    report = generate("--table", "-0.15", "--protocol", "none", "--output", str(path))
    assert report["candidates"] >= report["num"] == report["asked"] == 3
    assert report["shortage"] is None
    problem = GraspProblem(loaded_hand("gripper3"), load_object("sphere"), constraints=Constraints(table=-0.15))
    assert feasible(problem, GraspBatch.load(path)).all()


def test_impossible_table_says_so(weights: str, capsys: pytest.CaptureFixture[str]) -> None:
    base = ["generate", "--hand", "gripper3", "--object", "sphere", "--weights", weights, "--num", "2"]
    assert main([*base, "--table", "5"]) == 2
    assert "leaves nothing of the object" in capsys.readouterr().err


def stored(folder: Path, holding: bool) -> Path:
    """Two grasps of the sphere that hold, or two of air."""
    hand, sphere = loaded_hand("gripper3"), load_object("sphere")
    if holding:
        found = refine(GraspProblem(hand, sphere), synthesize(hand, sphere, 24, 1, SynthesisConfig(batch_size=24, steps=20)))
        # As `generate` gets them without refinement: the controller makes pregrasp and squeeze.
        two = found.poses_only().without("pregrasp_joints", "squeeze_joints")
        two = two[simulate(hand, sphere, two).success][:2]
    else:
        two = palm_facing_starts(hand, sphere, 2, 0)
        away = two.T_object_wrist.clone()
        away[:, 2, 3] += 1.0
        two = two.replace(T_object_wrist=away)
    assert len(two) == 2
    two.save(folder / "stored.parquet")
    return folder / "stored.parquet"


def test_a_file_without_any_success_is_told(generate, tmp_path: Path, weights: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "grasps.parquet"
    arguments = ["generate", "--hand", "gripper3", "--object", "sphere", "--num", "2", "--weights", weights, "--json"]
    air = ["--source", str(stored(tmp_path, False)), "--no-refine"]
    assert main([*arguments, *air, "--only-successful", "--output", str(path)]) == 0
    said = capsys.readouterr()
    assert f"no grasp succeeded, so {path} holds none" in said.err
    assert json.loads(said.out)["origin"] == {"stored": 2}


def test_grasps_that_were_not_found_count_as_failures(
    generate, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of 16 that are asked for, the source has 2, which hold."""
    path, folder, two = tmp_path / "grasps.parquet", tmp_path / "folder", str(stored(tmp_path, True))
    folder.mkdir()
    report = generate("--output", str(path), "--no-refine", num=16, source=two)
    assert (report["asked"], report["num"], report["success"]) == (16, 2, 2)
    assert report["success_rate"] == pytest.approx(2 / 16)
    low, high = wilson_interval(2, 16)
    assert report["interval_95"] == pytest.approx([low, high])
    assert GraspBatch.load(path).asked == 16
    assert "2 of 16 hold under carry/1" in repr(GraspBatch.load(path))
    told = generate("--output", str(folder / "few.parquet"), "--only-successful", "--no-refine", num=16, source=two)
    assert told["success_rate"] == pytest.approx(2 / 16)
    assert GraspBatch.load(folder / "few.parquet").asked is None, "what was chosen by its outcome is no answer"
    capsys.readouterr()
    assert main(["evaluate", str(path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["asked"], told["num"], told["success"], told["success_rate"]) == (16, 2, 2, pytest.approx(2 / 16))
    assert told["interval_95"] == pytest.approx(wilson_interval(2, 16))
    assert told["objects"]["sphere"] == {"asked": 16, "num": 2, "success": 2}
    assert main(["evaluate", str(path)]) == 0
    assert f"2 of 16 succeeded: {2 / 16:.1%}" in capsys.readouterr().out
    # An object of which no grasp at all was found counts, too.
    grasps = GraspBatch.load(path)
    grasps.replace(asked_of={**grasps.asked_of, ("can", "unseen"): 4}).save(path)
    assert main(["evaluate", str(path)]) == 0
    assert "2 of 20 succeeded" in capsys.readouterr().out
    assert main(["evaluate", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["objects"]["can"] == {"asked": 4, "num": 0, "success": 0}



def test_a_picture_of_successes_shows_no_failures(
    generate, weights: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """And the viewer, which would not return, is not opened."""
    path, air = tmp_path / "grasps.png", str(stored(tmp_path, False))
    base = ["generate", "--hand", "gripper3", "--object", "sphere", "--num", "2", "--weights", weights, "--no-refine"]
    assert main([*base, "--source", air, "--only-successful", "--picture", str(path), "--view"]) == 0
    said = capsys.readouterr()
    assert f"sphere: no grasp succeeded, so {path} is not drawn" in said.err
    assert "sphere: no grasp succeeded, so there is none to view" in said.err
    assert "picture:" not in said.out
    assert "0 of 2 grasps succeeded" in said.out
    assert not path.exists()
    assert generate("--only-successful", "--no-refine", "--picture", str(path), source=air)["picture"] is None
