"""`dro-grasp clear`: what is stored, repeated and told; the tables are played."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dro_grasp as dro
from dro_grasp.arm.clearing.loop import Cleared, Pick
from dro_grasp.arm.clearing.trial import ClearTrial, ClearTrialConfig
from dro_grasp.cli.main import main

OBJECTS = ("can", "torus", "bottle")


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, tuple[str, ...], ClearTrialConfig]]:
    """Tables of which the first thing is always left."""
    asked = list[tuple[int, tuple[str, ...], ClearTrialConfig]]()

    def trial(robot: dro.Robot, objects: list[dro.ObjectModel], number: int, seed: int, *given: Any) -> ClearTrial:
        names = tuple(obj.name for obj in objects)
        asked.append((number, names, given[1]))
        lost = Pick((0.5, 0.1), "plan", "no grasp")
        done = tuple(Pick((0.4, 0.1 * i), "done") for i in range(1, len(names)))
        removed = (False,) + (True,) * len(done)
        judged = (("held", True), ("empty", True))
        return ClearTrial(names, removed, (False,) * len(names), Cleared((lost, *done), (lost,)), judged)

    monkeypatch.setattr("dro_grasp.arm.clearing.trial.clear_trial", trial)
    return asked


def clear(*more: object) -> int:
    return main(["clear", "--robot", "xarm7_leaphand", "--objects", *OBJECTS, *map(str, more)])


def test_tables_are_stored_told_and_not_repeated(
    played: list[Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "tables.jsonl"
    assert clear("--tables", 2, "--output", path, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["things"], told["removed"], told["picks"], told["judgements"], told["right"]) == (6, 4, 6, 4, 2)
    assert told["interval"] == list(dro.wilson_interval(4, 6))
    assert clear("--tables", 3, "--output", path) == 0
    assert [number for number, *_ in played] == [0, 1, 2]
    out = capsys.readouterr().out
    assert "6 of 9 things removed (67%, 95 % interval" in out
    assert "with 1.50 picks each" in out
    assert "3 of 6 judgements are right" in out
    assert "no grasp" in out
    assert clear("--tables", 3, "--output", path, "--json") == 0
    resumed = json.loads(capsys.readouterr().out)["results"]
    assert resumed[:2] == told["results"]
    assert clear("--seed", 1, "--output", path) == 0
    assert clear("--tries", 2, "--output", path) == 0
    assert len(played) == 5, "another seed and other settings are other tables"
    assert len(path.read_text().splitlines()) == 5


def test_each_table_is_drawn_of_the_objects(played: list[Any]) -> None:
    assert clear("--things", 2, "--tables", 4, "--bin", 0.2, 0.4, 0.3, 0.25, 0.1) == 0
    assert all(len(set(names)) == 2 and set(names) <= set(OBJECTS) for _, names, _ in played)
    assert len({names for _, names, _ in played}) > 1
    box = played[0][2].clear.bin
    assert (box.centre, box.size, box.height) == ((0.2, 0.4), (0.3, 0.25), 0.1)


@pytest.mark.parametrize(("given", "told"), [
    (("--things", 4), "1 table of 4 things is asked for, of 3 objects"), (("--tables", 0), "0 tables of 3 things"),
    (("--tries", 0), "tries is 0; give at least 1"), (("--bin", 0, 0, 0, 0, 0), "size (0.0, 0.0) and walls of 0.0 m"),
    (("--bin", "nan", 0.3, 0.3, 0.3, 0.1), "the bin has centre (nan, 0.3)"),
    (("--output", "tables.csv"), "give a name that ends in .jsonl"), (("--video", "clear.mp4"), ".gif or .webp"),
])
def test_what_cannot_be_done_is_refused(
    played: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    given: tuple[object, ...], told: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert clear(*given) == 2
    assert told in capsys.readouterr().err
    assert played == []


def test_a_bare_cloud_is_refused_before_a_table_is_drawn(played: list[Any], tmp_path: Path, capsys) -> None:
    np.save(tmp_path / "points.npy", dro.load_object("sphere").cloud)
    for number in range(4):  # whichever of them the tables hold
        robot = ["clear", "--robot", "xarm7_leaphand", "--objects", *OBJECTS, str(tmp_path / "points.npy")]
        assert main([*robot, "--things", "1", "--seed", str(number)]) == 2
        assert "object 'points' is a bare cloud" in capsys.readouterr().err
    assert played == []


def test_a_file_that_is_no_file_of_tables_stays(
    played: list[Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "other.jsonl"
    path.write_text('{"a": 1}\n')
    assert clear("--output", path) == 2
    assert "a file of cleared tables" in capsys.readouterr().err
    assert path.read_text() == '{"a": 1}\n'


@pytest.mark.parametrize("seed", [-1, 2**31])
def test_a_seed_out_of_range_is_refused(seed: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert clear("--seed", seed) == 2
    assert f"seed is {seed}; give an integer from 0" in capsys.readouterr().err


def test_a_table_on_which_nothing_moved_keeps_the_others(played: list[Any], tmp_path: Path, capsys) -> None:
    assert clear("--tables", 2, "--things", 2, "--record", tmp_path / "r.npz") == 2
    said = capsys.readouterr()
    assert [number for number, *_ in played] == [0, 1]
    assert "2 of 4 things removed" in said.out
    assert "nothing has moved" in said.err
