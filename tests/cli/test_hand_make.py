"""`hand make`: files, listing, refusals and picture."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
from PIL import Image

import dro_grasp as dro
from dro_grasp.cli.main import main


def make(folder: Path, *more: str) -> int:
    return main(["hand", "make", "--output", str(folder), "--json", *more])


def test_hands_are_written_listed_and_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, sheet = tmp_path / "hands", tmp_path / "sheet.png"
    assert make(folder, "--seed", "13", "--num", "2", "--picture", str(sheet)) == 0
    told = json.loads(capsys.readouterr().out)
    assert [hand["name"] for hand in told["hands"]] == ["hand_00013", "hand_00014"]
    assert sum(told["redrawn"].values()) == sum(hand["redrawn"] for hand in told["hands"])
    assert (folder / "hand_00013.urdf").read_text() == dro.make_hand(13).urdf
    with Image.open(sheet) as picture:
        assert len(picture.convert("RGB").getcolors(1 << 24) or []) > 50

    assert make(folder, "--seed", "7", "--num", "1") == 0
    rows = list(csv.DictReader((folder / "hands.csv").read_text().splitlines()))
    assert [row["name"] for row in rows] == ["hand_00007", "hand_00013", "hand_00014"], "earlier rows stay"
    for row in rows:
        hand = dro.load_hand(folder / f"{row['name']}.urdf")
        assert len(hand.fingers) == int(row["fingers"])
        assert hand.tree.n_dof == int(row["joints"]) - int(row["mimic_joints"])


def test_existing_files_are_refused_before_the_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "hand_00013.urdf").write_text("mine")
    assert make(tmp_path, "--seed", "12", "--num", "2") == 2
    assert "1 of 2 files exist" in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["hand_00013.urdf"]
    assert make(tmp_path, "--seed", "13", "--num", "1", "--overwrite") == 0
    assert (tmp_path / "hand_00013.urdf").read_text().startswith("<?xml")


@pytest.mark.parametrize(("option", "value"), [("--num", "0"), ("--seed", "-1")])
def test_impossible_numbers_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str, value: str) -> None:
    assert make(tmp_path, option, value) == 2
    told = capsys.readouterr().err
    assert f"{option[2:]} is {value}" in told
    assert option in told


@pytest.mark.parametrize("listing", ["a,b\n1,2\n", "name,more\nhand_00001,x\n"])
def test_a_foreign_listing_is_refused_and_an_older_one_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], listing: str
) -> None:
    (tmp_path / "hands.csv").write_text(listing)
    code = make(tmp_path, "--num", "1")
    if "name" in listing:
        assert code == 0
        assert (tmp_path / "hands.csv").read_text().splitlines()[2].startswith("hand_00001,")
        return
    assert code == 2
    assert "hands.csv cannot be read" in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["hands.csv"], "before the work"
