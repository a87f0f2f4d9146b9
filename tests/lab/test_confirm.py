"""Whether results of earlier code count as those of the present code, by commands that print numbers."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lab import confirm, reading, runner
from lab.measurements import Measurement

COMMAND = "python -c \"print(open('{file}').read())\""


@pytest.fixture
def measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two commands that print what a file holds; their results are of code that has changed since."""
    file = tmp_path / "numbers.json"
    file.write_text(json.dumps({"rows": [{"held": 0.5, "seconds": 3.0}]}))
    declared = {"quick": Measurement("Numbers", {name: COMMAND.format(file=file) + f" {name}" for name in ("one", "two")}, ())}
    for module in (runner, confirm):
        monkeypatch.setattr(module, "MEASUREMENTS", declared)
        monkeypatch.setattr(module, "uncommitted", list)
    monkeypatch.setattr(runner, "RESULTS", tmp_path / "results")
    assert runner.main([]) == 0
    path, cells = tmp_path / "results" / "quick.json", runner.read("quick")["cells"]
    for name, seconds in (("one", 9.0), ("two", 1.0)):
        cells[name] |= {"seconds": seconds, "code": cells[name]["code"] | {"src/dro_grasp/simulation": "0" * 12}}
    path.write_text(json.dumps({"cells": cells}))
    assert runner.main(["--stale"]) == 1
    return file


def test_the_same_numbers_of_the_quickest_command_count_for_all(
    measured: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    measured.write_text(json.dumps({"rows": [{"held": 0.5 + 1e-12, "seconds": 8.0}]}))
    assert confirm.main([]) == 0
    assert "quick: two came out the same; all 2 results count" in capsys.readouterr().out
    cells = runner.read("quick")["cells"]
    assert {cell["confirmed"]["by"] for cell in cells.values()} == {"two"}
    assert all(cell["code"]["src/dro_grasp/simulation"] == "0" * 12 for cell in cells.values()), "it stays what was measured"
    assert reading.mixed(cells) == []
    assert runner.main(["--stale"]) == 0
    assert confirm.main([]) == 0
    assert "nothing is stale by its code alone" in capsys.readouterr().out


@pytest.mark.parametrize("now", [{"rows": [{"held": 0.5001, "seconds": 3.0}]}, {"rows": []}, {"rows": [{"seconds": 3.0}]},
                                 {"rows": [{"held": "0.5", "seconds": 3.0}]}])
def test_other_numbers_confirm_nothing(measured: Path, now: object, capsys: pytest.CaptureFixture[str]) -> None:
    measured.write_text(json.dumps(now))
    assert confirm.main([]) == 1
    assert "quick: two came out otherwise: result.rows" in capsys.readouterr().out
    assert runner.main(["--stale"]) == 1


def test_a_command_that_fails_confirms_nothing(measured: Path, capsys: pytest.CaptureFixture[str]) -> None:
    measured.unlink()
    assert confirm.main([]) == 1
    assert "quick: two failed" in capsys.readouterr().out


@pytest.mark.parametrize("change", [{"weights": {"w.safetensors": "0" * 12}}, {"command": "python -c 'print(2)'"}])
def test_results_of_other_weights_or_commands_are_not_asked_about(measured: Path, change: dict[str, object]) -> None:
    path = runner.RESULTS / "quick.json"
    cells = json.loads(path.read_text())["cells"]
    cells["one"] |= change
    path.write_text(json.dumps({"cells": cells}))
    assert confirm.confirmable("quick") == []


def test_results_of_two_states_are_not_confirmed_as_one(measured: Path) -> None:
    path = runner.RESULTS / "quick.json"
    cells = json.loads(path.read_text())["cells"]
    cells["one"]["code"] |= {"src/dro_grasp/simulation": "1" * 12}
    path.write_text(json.dumps({"cells": cells}))
    assert confirm.confirmable("quick") == []


def test_times_are_measured_anew(measured: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(confirm.confirmable("quick")) == 2
    alone = {"quick": Measurement("Times", confirm.MEASUREMENTS["quick"].cells, (), alone=True)}
    monkeypatch.setattr(confirm, "MEASUREMENTS", alone)
    assert confirm.confirmable("quick") == []
