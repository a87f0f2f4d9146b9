"""Names of output files: what a file holds shows in its ending, and another ending is refused before anything is read."""

from __future__ import annotations

from pathlib import Path

import pytest

from dro_grasp.cli.main import main
from dro_grasp.errors import OutputError
from dro_grasp.files import check_output
from dro_grasp.objects.catalogue import load_object
from dro_grasp.predict.sources.controls import palm_facing_starts
from tests.helpers.loaded_hands import loaded_hand

PLAN = ["plan", "--robot", "no", "--object", "no"]
TABLETOP = ["tabletop", "--robot", "no", "--objects", "sphere"]
TRAINING = ["--bundle", "no", "--run-folder", "no"]
OUTPUTS = {
    "generate": (["generate", "--hand", "no", "--object", "no", "--output"], ".parquet"),
    "generate --picture": (["generate", "--hand", "no", "--object", "no", "--picture"], ".png"),
    "evaluate": (["evaluate", "no", "--output"], ".parquet"),
    "picture": (["picture", "no", "--output"], ".png"),
    "dataset report": (["dataset", "report", "no", "--output"], ".html or .htm"),
    "dataset bundle": (["dataset", "bundle", "no", "--output"], ".safetensors"),
    "pretrain": (["pretrain", *TRAINING, "--output"], ".safetensors"),
    "train": (["train", *TRAINING, "--output"], ".safetensors"),
    "hand check": (["hand", "check", "no", "--picture"], ".png"),
    "hand make": (["hand", "make", "--output", "no", "--picture"], ".png"),
    "hand vary": (["hand", "vary", "no", "--mirrored", "--output"], ".urdf"),
    "robot check": (["robot", "check", "no", "--picture"], ".png"),
    "plan": ([*PLAN, "--output"], ".npz"),
    "plan --trajectory": ([*PLAN, "--trajectory"], ".yaml or .yml"),
    "plan --csv": ([*PLAN, "--csv"], ".csv"),
    "tabletop": ([*TABLETOP, "--output"], ".parquet"),
    "tabletop --video": ([*TABLETOP, "--video"], ".gif or .webp"),
}


@pytest.mark.parametrize("name", ["out.txt", "out"])
@pytest.mark.parametrize("command", OUTPUTS)
def test_another_ending_is_refused_before_anything_is_read(
    command: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words, endings = OUTPUTS[command]
    assert main([*words, name]) == 2
    suggestion = f"out{endings.split()[0]}"
    assert f"error: cannot write {name}: give a name that ends in {endings}, such as {suggestion}" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("format", "ending"), [("csv", ".csv"), ("moveit", ".yaml or .yml")])
def test_so_it_is_with_exports_of_one_object(
    format: str, ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    palm_facing_starts(loaded_hand("gripper3"), load_object("can"), num=1, seed=0).save("a.parquet")
    assert main(["export", "a.parquet", "--format", format, "--output", "a.txt"]) == 2
    assert f"cannot write a.txt: give a name that ends in {ending}, such as" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["a.parquet"]


@pytest.mark.parametrize("name", ["a.yaml", "a.YML"])
def test_capitals_and_short_forms_are_the_same_ending(tmp_path: Path, name: str) -> None:
    assert check_output(tmp_path / name, ".yaml") == tmp_path / name
    with pytest.raises(OutputError, match=r"ends in \.png, such as a\.png"):
        check_output(tmp_path / name, ".png")
    with pytest.raises(OutputError, match="it is a folder"):
        check_output(".", ".png")
