"""Whether results of earlier code count as those of the present code, by commands that print numbers."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from dro_grasp.provenance import commit
from lab import confirm, reading, runner
from lab.measurements import Measurement

COMMAND = "python -c \"print(open('numbers.json').read())\""
NUMBERS = json.dumps({"rows": [{"held": 0.5, "seconds": 3.0}]})


@pytest.fixture
def measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two commands that print what a file of the checkout holds; their results are of code that has changed since."""
    for folder in ("then", "now"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "numbers.json").write_text(NUMBERS)

    @contextlib.contextmanager
    def checkout(state: str) -> Iterator[Path]:
        assert state == "0123456789"
        yield tmp_path / "then"

    declared = {"quick": Measurement("Numbers", {name: f"{COMMAND} {name}" for name in ("one", "two")}, ())}
    for module in (runner, confirm):
        monkeypatch.setattr(module, "MEASUREMENTS", declared)
        monkeypatch.setattr(module, "uncommitted", list)
        monkeypatch.setattr(module, "commit", lambda: "fedcba9876")
    monkeypatch.setattr(confirm, "checkout", checkout)
    monkeypatch.setattr(confirm, "ROOT", tmp_path / "now")
    monkeypatch.setattr(runner, "RESULTS", tmp_path / "results")
    monkeypatch.chdir(tmp_path / "now")
    monkeypatch.setattr(runner, "measure", lambda job, beside: {
        "command": job.command, "commit": "0123456789", **job.state, "result": json.loads(NUMBERS)})
    assert runner.main([]) == 0
    path, cells = tmp_path / "results" / "quick.json", runner.read("quick")["cells"]
    for name, seconds in (("one", 9.0), ("two", 1.0)):
        cells[name] |= {"seconds": seconds, "code": cells[name]["code"] | {"src/dro_grasp/simulation": "0" * 12}}
    path.write_text(json.dumps({"cells": cells}))
    assert runner.main(["--stale"]) == 1
    return tmp_path / "now" / "numbers.json"


def test_the_same_numbers_of_the_quickest_command_count_for_all(
    measured: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    measured.write_text(json.dumps({"rows": [{"held": 0.5 + 1e-12, "seconds": 8.0}]}))
    assert confirm.main([]) == 0
    assert "quick: two comes out the same as at 0123456789; all 2 results count" in capsys.readouterr().out
    cells = runner.read("quick")["cells"]
    assert {(cell["confirmed"]["by"], cell["confirmed"]["commit"]) for cell in cells.values()} == {("two", "fedcba9876")}
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
    assert "quick: two comes out otherwise than at 0123456789: result.rows" in capsys.readouterr().out
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


@pytest.mark.skipif(not commit(), reason="needs git's history")
def test_a_command_is_run_with_the_files_of_a_commit(tmp_path: Path) -> None:
    state = runner.git("rev-parse", "HEAD").strip()
    with confirm.checkout(state) as folder:
        assert folder != runner.ROOT
        assert (folder / "lab" / "runner.py").is_file()
        assert confirm.printed("python -c \"import json, os; print(json.dumps(os.getcwd()))\"", folder, True) == str(folder)
        where = "python -c \"import dro_grasp, json; print(json.dumps(dro_grasp.__file__))\""
        assert Path(confirm.printed(where, folder, beside=True)).is_relative_to(folder)
    assert not folder.exists()
    assert str(folder) not in runner.git("worktree", "list")
