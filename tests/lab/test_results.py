"""What README and docs tell comes from lab/results: pages equal their data, a table is of one state, and nothing is typed."""

from __future__ import annotations

import json
import re
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from lab import figure, pages, runner, tables
from lab.measurements import MEASUREMENTS, Measurement

PERCENT = re.compile(r"(?<![\w.])(?!95 %)\d+(?:\.\d+)? ?%")
RATE = re.compile(r"\d+(?:\.\d+)? \[\d+-\d+\]")


def test_pages_are_what_their_data_say() -> None:
    assert [str(page.relative_to(runner.ROOT)) for page, _ in tables.outdated()] == []


@pytest.mark.parametrize("each", figure.FIGURES, ids=lambda each: each.path.stem)
def test_a_figure_is_of_its_data(each: figure.Figure) -> None:
    assert not each.is_old(), "run `make tables`"


@pytest.mark.parametrize("page", tables.PAGES, ids=lambda page: page.name)
def test_no_measured_number_is_typed(page: Path) -> None:
    typed = pages.unmarked(page.read_text())
    assert PERCENT.findall(typed) == []
    assert RATE.findall(typed) == []


def test_every_table_that_can_be_written_is_somewhere_and_none_is_twice() -> None:
    named = [name for page in tables.PAGES for _, name, _ in pages.MARKED.findall(page.read_text())]
    assert sorted(set(named)) == sorted({*tables.TABLES, *tables.VALUES})
    tabled = [name for page in tables.PAGES for kind, name, _ in pages.MARKED.findall(page.read_text()) if kind == "table"]
    assert len(tabled) == len(set(tabled))


def test_results_are_of_commands_that_are_declared_and_of_known_code() -> None:
    for path in runner.RESULTS.glob("*.json"):
        cells = json.loads(path.read_text())["cells"]
        assert set(cells) <= set(MEASUREMENTS[path.stem].cells), path.name
        for cell in cells.values():
            assert re.fullmatch(r"[0-9a-f]{10}|unknown", cell["commit"]), path.name
            assert cell["code"], path.name
            assert {"command", "code", "weights", "machine", "date", "load", "seconds", "result"} <= set(cell)


def kept(folder: Path, name: str, changes: dict) -> dict:
    """A result in a folder of its own, changed."""
    cells = json.loads((runner.RESULTS / f"{name}.json").read_text())["cells"]
    first = next(iter(cells))
    cells[first] = {**cells[first], **changes}
    (folder / f"{name}.json").write_text(json.dumps({"cells": cells}))
    return cells


@pytest.mark.parametrize("changes", [{"weights": {"more.safetensors": "0"}}, {"code": {"src/dro_grasp/simulation": "0"}}])
def test_a_table_of_two_states_is_refused(tmp_path: Path, changes: dict) -> None:
    kept(tmp_path, "constraints", changes)
    with pytest.raises(ValueError, match="mix states"):
        tables.writer("constraints.cost", tables.constraints, tmp_path)


def test_rows_of_what_robots_do_may_be_of_other_states_than_each_other(tmp_path: Path) -> None:
    cells = json.loads((runner.RESULTS / "asked.json").read_text())["cells"]
    other = {name: {**cell, "weights": {"more.safetensors": "0"}, "commit": "0123456789"} for name, cell in cells.items()}
    (tmp_path / "asked.json").write_text(json.dumps({"cells": other}))
    (tmp_path / "holding.json").write_text((runner.RESULTS / "holding.json").read_text())
    rows = [line.split("|")[1:-1] for line in tables.writer("robots.tasks", tables.robot_tasks, tmp_path).splitlines()]
    commits = {row[0]: row[-1] for row in rows[2:] if row[-1]}
    holding = json.loads((tmp_path / "holding.json").read_text())["cells"]["allegro"]["commit"]
    assert set(commits.values()) == {"0123456789", holding}


def test_a_row_of_what_robots_do_is_of_one_state(tmp_path: Path) -> None:
    kept(tmp_path, "asked", {"code": {"src/dro_grasp/simulation": "0"}})
    with pytest.raises(ValueError, match=r"asked for among three others.* would mix states: code of src/dro_grasp/simulation"):
        tables.writer("robots.tasks", tables.robot_tasks, tmp_path)


def test_a_result_of_another_command_counts_as_not_measured(tmp_path: Path) -> None:
    kept(tmp_path, "constraints", {"command": "another"})
    assert tables.writer("constraints.cost", tables.constraints, tmp_path).startswith("not measured")


def test_what_was_not_measured_says_so(tmp_path: Path) -> None:
    assert tables.writer("constraints.cost", tables.constraints, tmp_path) == (
        "not measured (`make results NAMES=constraints`)")


@pytest.mark.parametrize("each", figure.FIGURES, ids=lambda each: each.path.stem)
def test_a_figure_of_what_was_not_measured_says_so(each: figure.Figure, tmp_path: Path) -> None:
    from PIL import Image

    nothing = each.data(tables.Results(tmp_path))
    assert nothing == {}
    each.draw(nothing, tmp_path / "figure.png")
    with Image.open(tmp_path / "figure.png") as image:
        assert image.text["Description"] == figure.digest({})


def test_every_measured_rate_stands_beside_that_of_carry() -> None:
    for name, measurement in MEASUREMENTS.items():
        for cell, command in measurement.cells.items():
            if command.startswith("dro-grasp benchmark"):
                assert " --protocols carry " in f"{command} ", (name, cell)


def test_hard_objects_are_measured_with_eight_grasps_of_each_pair() -> None:
    for name in ("hard", "published_hard"):
        for command in MEASUREMENTS[name].cells.values():
            assert "--objects builtin:hard_test --num 32 --stages returned " in command  # a quarter is returned
    assert [len(MEASUREMENTS[name].cells) for name in ("hard", "published_hard")] == [3, 12]


def test_a_page_is_written_between_its_markers_only() -> None:
    text = "a <!-- value one -->old<!-- end --> b\n<!-- table two -->\nold\n<!-- end -->\n"
    wanted = "a <!-- value one -->1 %<!-- end --> b\n<!-- table two -->\n| x |\n<!-- end -->\n"
    assert pages.rendered(text, {"two": lambda: "| x |"}, {"one": lambda: "1 %"}) == wanted
    assert pages.unmarked(wanted + "5 `6 %`") == "a  b\n\n5 "
    with pytest.raises(KeyError):
        pages.rendered(text, {}, {})


class TestRunner:
    """A measurement of one quick command, with its results in a folder of their own."""

    @pytest.fixture(autouse=True)
    def one(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        script = tmp_path / "count.py"
        script.write_text(
            f"import pathlib\nseen = pathlib.Path({str(tmp_path / 'seen')!r})\nwith seen.open('a') as f:\n    f.write('x')\n"
            "print('noise')\nprint('{\"number\": 1}')\n")
        monkeypatch.setattr(runner, "MEASUREMENTS", {"quick": Measurement("A number", {"one": f"python {script}"}, ())})
        monkeypatch.setattr(runner, "RESULTS", tmp_path / "results")
        monkeypatch.setattr(runner, "uncommitted", list)
        self.seen = tmp_path / "seen"

    def runs(self) -> int:
        return len(self.seen.read_text()) if self.seen.exists() else 0

    def test_what_is_there_is_not_run_again(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert runner.main(["--stale"]) == 1
        assert "1 of 1 commands, missing" in capsys.readouterr().out
        assert runner.main([]) == 0
        assert runner.main([]) == 0
        assert self.runs() == 1
        assert runner.read("quick")["cells"]["one"]["result"] == {"number": 1}
        assert runner.main(["--stale"]) == 0

    def test_results_that_are_not_committed_yet_do_not_mark_the_next_one(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(runner, "commit", lambda: "0123456789+")
        runner.main([])
        assert runner.read("quick")["cells"]["one"]["commit"] == "0123456789"

    def test_what_needs_a_folder_that_takes_hours_waits_for_it(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        needy = replace(runner.MEASUREMENTS["quick"], needs="out/labels")
        monkeypatch.setattr(runner, "MEASUREMENTS", {"quick": needy})
        monkeypatch.setattr(runner, "ROOT", tmp_path)
        assert runner.main(["--stale"]) == 0
        assert "(needs out/labels)" in capsys.readouterr().out
        assert runner.main([]) == 0
        assert self.runs() == 0
        (tmp_path / "out/labels").mkdir(parents=True)
        assert runner.at_hand(needy)
        assert runner.main(["--stale"]) == 1

    def test_what_is_older_than_its_code_or_weights_is_run_again(self, monkeypatch: pytest.MonkeyPatch) -> None:
        runner.main([])
        monkeypatch.setattr(runner, "weights_hashes", lambda: {"new.safetensors": "1"})
        (job,) = runner.jobs_of("quick", runner.MEASUREMENTS["quick"])
        assert "new.safetensors" in runner.reason(job)
        runner.main([])
        assert self.runs() == 2

    def test_a_command_that_fails_is_told_and_keeps_nothing(
        self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        fault = Measurement("A fault", {"one": "python -c 'raise SystemExit(\"no\")'"}, ())
        monkeypatch.setattr(runner, "MEASUREMENTS", {"quick": fault})
        assert runner.main([]) == 1
        assert "no" in capsys.readouterr().out
        assert not (runner.RESULTS / "quick.json").exists()

    def test_a_command_that_prints_nothing_is_told_and_the_others_are_run(
        self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        cells = {"one": "python -c pass", "two": "python -c 'print(2)'"}
        monkeypatch.setattr(runner, "MEASUREMENTS", {"quick": Measurement("Silence", cells, ())})
        assert runner.main(["--workers", "1"]) == 1
        assert "quick: two: done" in capsys.readouterr().out
        assert list(runner.read("quick")["cells"]) == ["two"]

    def test_a_result_is_of_the_commit_at_which_it_began(self, monkeypatch: pytest.MonkeyPatch) -> None:
        honest = runner.subprocess.run

        def run(*given: object, **options: object) -> object:
            monkeypatch.setattr(runner, "commit", lambda: "later")
            return honest(*given, **options)

        monkeypatch.setattr(runner, "commit", lambda: "begun")
        monkeypatch.setattr(runner.subprocess, "run", run)
        runner.main([])
        assert runner.read("quick")["cells"]["one"]["commit"] == "begun"

    def test_nothing_is_measured_with_uncommitted_changes(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(runner, "uncommitted", lambda: ["src/dro_grasp/kinds.py"])
        with pytest.raises(SystemExit):
            runner.main([])
        assert self.runs() == 0


def test_code_counts_by_its_syntax_without_docstrings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "ROOT", tmp_path)
    hashes = []
    for text in ('"""One."""\nx = 1\n', '"""Two."""\n\n# Why.\nx = 1\n', '"""One."""\nx = 2\n'):
        (tmp_path / "m.py").write_text(text)
        runner.code_hash.cache_clear()
        hashes.append(runner.code_hash("m.py"))
    runner.code_hash.cache_clear()
    assert hashes[0] == hashes[1] != hashes[2]


PROBE = '''
@once
class A(B, c=1):
    x: dict[str, float] = {**y, "\u00e9\U0001fae9": None}
    async def f(self, a, /, b=2.5, *c, d=..., **e) -> None:
        with open(a) as g, h:
            return f"{a!r:>{b}} {c=}" f"z" if a[1:] else lambda: (yield)
    def g(): pass
match x:
    case {"a": [1, *_]} | None: del x
try:
    x = [k async for k in y if (z := k)]
except* E as e:
    raise e from None
'''


def test_the_hash_of_code_is_the_same_in_each_version_of_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "ROOT", tmp_path)
    (tmp_path / "probe.py").write_text(PROBE)
    runner.code_hash.cache_clear()
    assert runner.code_hash("probe.py") == "660bc4a6ca35"  # by Python 3.11, 3.12 and 3.13
    runner.code_hash.cache_clear()


def test_results_of_a_copy_without_git_say_by_its_hash_of_which_code_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "MEASUREMENTS", {"quick": Measurement("A number", {"one": "python -c 'print(1)'"}, ())})
    monkeypatch.setattr(runner, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(runner, "commit", lambda: "")
    monkeypatch.setattr(runner, "git", lambda *arguments: pytest.fail("there is no git"))
    assert runner.main([]) == 0
    cell = runner.read("quick")["cells"]["one"]
    assert cell["commit"] == "unknown"
    assert cell["code"]["src/dro_grasp/simulation"] == runner.code_hash("src/dro_grasp/simulation")
    assert runner.main(["--stale"]) == 0


def test_changes_of_code_count_as_uncommitted_and_results_do_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "ROOT", tmp_path)
    for name in ("src/a.py", "lab/b.py", "lab/results/c.json", "lab/notebook/d.md", "docs/e.md"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("1\n")
    identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
    for arguments in (["init", "-q"], ["add", "-A"], [*identity, "commit", "-qm", "first"]):
        subprocess.run(["git", *arguments], cwd=tmp_path, check=True)
    assert runner.uncommitted() == []
    for name in ("lab/results/c.json", "lab/notebook/d.md", "docs/e.md"):
        (tmp_path / name).write_text("2\n")
    assert runner.uncommitted() == []
    (tmp_path / "src/a.py").write_text("2\n")
    (tmp_path / "lab/new.py").write_text("2\n")
    assert sorted(runner.uncommitted()) == ["lab/new.py", "src/a.py"]


def test_the_error_of_payloads_is_the_median_of_what_trials_held(tmp_path: Path) -> None:
    rows = [{"trials": t, "weighed": w, "trials again": a} for t, w, a in
            ((1.0, 1.1, 1.02), (2.0, 1.0, 2.0), (0.5, 0.6, 0.55), (0.01, 3.0, 0.01))]
    cells = {name: {"command": command, "result": {"rows": rows}} for name, command in MEASUREMENTS["payload"].cells.items()}
    (tmp_path / "payload.json").write_text(json.dumps({"cells": cells}))
    told = tables.payload_error(tables.Results(tmp_path))
    count = len(cells)
    assert told == f"20 % in the median of {3 * count} grasps (trials repeated: 2 %; {count} more held no mass in trials)"
