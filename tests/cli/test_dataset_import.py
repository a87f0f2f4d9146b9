"""`dataset import`: what it prints, says aside and writes; formats are tested where they are read."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from dro_grasp.cli.main import main
from dro_grasp.grasps.grasp_file import read_footer
from dro_grasp.hands.library import BUILTIN_FOLDER
from tests.helpers.loaded_hands import loaded_hand


@pytest.fixture
def theirs(tmp_path: Path) -> str:
    """Three grasps of a hand that they call so: two of a ball, one of something unknown."""
    q = torch.cat([torch.zeros(6), loaded_hand("gripper3").canonical_joints()])
    torch.save({"metadata": [(q, name, "theirs") for name in ("sphere", "sphere", "nothing+here")]}, tmp_path / "theirs.pt")
    return str(tmp_path / "theirs.pt")


def imported(theirs: str, *options: str) -> int:
    return main(["dataset", "import", theirs, "--format", "cmap", *options])


def test_a_table_lists_the_files_and_what_is_left_out_is_said_aside(
    theirs: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert imported(theirs, "--hands", "theirs=gripper3", "--output", "out/here") == 0
    said = capsys.readouterr()
    assert "grasps of nothing+here are left out: " in said.err
    row = next(line for line in said.out.splitlines() if "gripper3" in line)
    assert [cell.strip() for cell in row.strip(" │").split("│")] == ["gripper3", "1", "2", "out/here/gripper3.parquet"]
    assert "`dro-grasp dataset filter` keeps those that pass a trial" in said.out
    assert read_footer(tmp_path / "out/here/gripper3.parquet")[0] == 2


def test_one_object_may_be_given_for_all_grasps(theirs: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--hands", "theirs=gripper3", "--object", "can", "--output", str(tmp_path / "out"), "--json"]
    assert imported(theirs, *options) == 0
    (file,), missing = json.loads(capsys.readouterr().out).values()
    assert not missing
    assert file == {"hand": "gripper3", "objects": 1, "grasps": 3, "file": str(tmp_path / "out" / "gripper3.parquet")}


def test_nothing_imported_is_status_2_and_a_program_learns_why(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    q = torch.cat([torch.zeros(6), loaded_hand("gripper3").canonical_joints()])
    torch.save({"metadata": [(q, "nothing+here", "gripper3")]}, tmp_path / "theirs.pt")
    assert imported(str(tmp_path / "theirs.pt"), "--output", str(tmp_path / "out"), "--json") == 2
    told = json.loads(capsys.readouterr().out)
    assert told["files"] == []
    assert list(told["missing"]) == ["nothing+here"]
    assert not (tmp_path / "out").exists()


def test_an_output_that_is_a_file_is_refused_before_the_work(
    theirs: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").write_text("mine")
    assert imported("missing.pt", "--output", str(tmp_path / "out")) == 2
    assert f"{tmp_path / 'out'} is a file; give a folder" in capsys.readouterr().err
    assert (tmp_path / "out").read_text() == "mine"


def test_two_hands_without_names_in_the_file_are_refused(
    theirs: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert imported(theirs, "--hands", "barrett", "gripper3", "--output", str(tmp_path / "out")) == 2
    assert "--hands names barrett and gripper3 for all hands of the files" in capsys.readouterr().err


def of_two_hands(folder: Path) -> str:
    """A grasp of each of two hands, of a ball."""
    q = torch.cat([torch.zeros(6), loaded_hand("gripper3").canonical_joints()])
    torch.save({"metadata": [(q, "sphere", name) for name in ("left", "right")]}, folder / "two.pt")
    return str(folder / "two.pt")


def test_two_hands_whose_files_have_one_name_do_not_replace_each_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        (tmp_path / side / "mine.urdf").write_text((BUILTIN_FOLDER / "gripper3.urdf").read_text() + f"<!-- {side} -->")
    hands = [f"{side}={tmp_path / side / 'mine.urdf'}" for side in ("left", "right")]
    assert imported(of_two_hands(tmp_path), "--hands", *hands, "--output", str(tmp_path / "out")) == 2
    assert "are both called 'mine'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_one_file_under_two_paths_is_one_hand(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.urdf").write_text((BUILTIN_FOLDER / "gripper3.urdf").read_text())
    hands = [f"left={tmp_path / 'mine.urdf'}", f"right={tmp_path}/../{tmp_path.name}/mine.urdf"]
    output = ["--output", str(tmp_path / "out"), "--json"]
    assert imported(of_two_hands(tmp_path), "--hands", *hands, *output) == 0
    (file,), _ = json.loads(capsys.readouterr().out).values()
    assert (file["hand"], file["grasps"]) == ("mine", 2)
