"""Evaluating grasps on another hand or object than their own: told, and never stored as outcomes of their own."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from dro_grasp.cli.main import main
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.library import BUILTIN_FOLDER
from dro_grasp.objects.catalogue import load_object
from dro_grasp.predict.sources.controls import palm_facing_starts
from tests.helpers.loaded_hands import loaded_hand


def test_evaluation_with_another_hand_is_told(weights: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.urdf").write_text((BUILTIN_FOLDER / "gripper3.urdf").read_text())
    path, output = tmp_path / "grasps.parquet", tmp_path / "tried.parquet"
    assert main(["generate", "--hand", str(tmp_path / "mine.urdf"), "--object", "sphere", "--weights", weights, "--num", "1",
                 "--source", "network", "--protocol", "none", "--output", str(path), "--json"]) == 0
    assert main(["evaluate", str(path), "--hand", "gripper3"]) == 0
    assert "made for another" not in capsys.readouterr().err
    assert main(["evaluate", str(path), "--hand", "gripper3", "--output", str(output)]) == 0
    output.unlink()
    with (tmp_path / "mine.urdf").open("a") as file:
        file.write("<!-- changed -->")
    assert main(["evaluate", str(path)]) == 0
    assert "made for another 'mine' than the given mine" in capsys.readouterr().err
    assert main(["evaluate", str(path), "--output", str(output)]) == 2
    assert "another hand 'mine'" in capsys.readouterr().err
    assert not output.exists()
    assert main(["evaluate", str(path), "--hand", "gripper3", "--output", str(output)]) == 0


def test_outcomes_on_another_object_are_not_stored_as_those_on_its_own(
    generate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path, output = tmp_path / "grasps.parquet", tmp_path / "tried.parquet"
    generate("--output", str(path), "--protocol", "none", num=1)
    grasps = GraspBatch.load(path)
    for asked in (["--object", "sphere"], ["--object", "can"]):
        grasps.replace(object_sha256=("",)).save(path)
        assert main(["evaluate", str(path), *asked, "--output", str(output)]) == 0
        output.unlink()
    grasps.save(path)
    assert main(["evaluate", str(path), "--object", "can", "--output", str(output)]) == 2
    said = capsys.readouterr().err
    for words in ("another object 'sphere' than the given can", "leave out --output", "generate grasps", str(output)):
        assert words in said
    # The second object of a file is refused before the trials of the first.
    changed = grasps.replace(object=("can",), object_sha256=("old",))
    GraspBatch.concatenate([grasps, changed]).save(path)
    monkeypatch.setattr("dro_grasp.predict.stages.evaluate", None)
    assert main(["evaluate", str(path), "--output", str(output)]) == 2
    assert "another object 'can'" in capsys.readouterr().err
    assert not output.exists()


def test_what_was_asked_for_in_vain_stays_in_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hand = loaded_hand("gripper3")
    found = palm_facing_starts(hand, load_object("sphere"), num=2, seed=0).with_asked(2)
    lost = GraspBatch.none(hand, load_object("can")).replace(asked_of={("can", load_object("can").sha256): 4})
    path, tried = tmp_path / "both.parquet", tmp_path / "tried.parquet"
    GraspBatch.concatenate([found, lost]).save(path)
    for file, *more in ((path, "--output", str(tried)), (tried,)):
        assert main(["evaluate", str(file), "--json", *more]) == 0
        assert json.loads(capsys.readouterr().out)["asked"] == 6


def test_an_output_in_the_folder_that_is_evaluated_is_refused(
    generate, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "made").mkdir()
    generate("--output", str(tmp_path / "made" / "a.parquet"), "--protocol", "none", num=1)
    assert main(["evaluate", str(tmp_path / "made"), "--output", str(tmp_path / "made" / "all.parquet")]) == 2
    assert "would be read twice from then on" in capsys.readouterr().err
    assert main(["evaluate", str(tmp_path / "made"), "--output", str(tmp_path / "all.parquet")]) == 0
    assert len(GraspBatch.load(tmp_path / "all.parquet")) == 1
