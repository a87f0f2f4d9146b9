"""Targets: what is reached, what is not, and what nobody measured."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from lab import targets
from lab.measurements import MEASUREMENTS, ROBOTS
from lab.reading import Results
from lab.targets import Found, Target

CELL = {"commit": "0123456789", "weights": {"a": "1"}, "code": {"b": "2"}}


@pytest.mark.parametrize(("value", "least", "end"), [
    (5.0, True, "reached"), (4.9, True, "**not reached**"), (5.0, False, "reached"), (5.1, False, "**not reached**")])
def test_a_value_is_held_against_its_goal(value: float, least: bool, end: str, tmp_path: Path) -> None:
    line = Target("x", "y", 5, lambda _: Found(value, f"{value}"), least, "s").line(Results(tmp_path))
    assert line == ["x", "y", f"at {'least' if least else 'most'} 5 s", f"{value}", "", end]


def test_what_nobody_measured_says_so(tmp_path: Path) -> None:
    for target in targets.targets():
        if target.subject != "hands":  # those are of the notebook
            assert target.line(Results(tmp_path))[3:] == ["", "", "not measured"], target.what


@pytest.mark.parametrize(("what", "told", "end"), [
    ("one of sixteen grasps with its candidates", "81", "**not reached**"), ("one grasp alone", "249", "reached")])
def test_a_grasp_s_time_is_of_predict_with_its_defaults(what: str, told: str, end: str, tmp_path: Path) -> None:
    """Not of candidates that nothing is chosen from."""
    cells = {name: {**CELL, "command": MEASUREMENTS["speed"].cells[name], "result": result} for name, result in {
        "returned": {"seconds_a_grasp": {"1": 0.249, "16": 0.081}},
        "inference": {"latency_default": 0.5, "batch16_per_grasp_default": 0.5}}.items()}
    (tmp_path / "speed.json").write_text(json.dumps({"cells": cells}))
    (line,) = (t.line(Results(tmp_path)) for t in targets.targets() if t.what == what)
    assert line[3:] == [told, "0123456789", end]


def test_a_rate_is_of_the_attempts_in_the_file(tmp_path: Path) -> None:
    cells = {name: {**CELL, "command": command, "result": {"attempts": [
        {"success": k < 3, "stage": "done"} for k in range(4)]}} for name, command in MEASUREMENTS["lifts"].cells.items()}
    (tmp_path / "lifts.json").write_text(json.dumps({"cells": cells}))
    (line,) = (t.line(Results(tmp_path)) for t in targets.targets() if t.what == "lifted, held and shaken, `ur5e_allegro`")
    assert line[3:] == ["75.0 [60-86] % of 40", "0123456789", "**not reached**"]


def test_a_row_of_two_states_is_refused(tmp_path: Path) -> None:
    cells = {name: {**CELL, "command": command, "weights": {"a": name}, "result": {"attempts": [
        {"success": True, "stage": "done"}]}} for name, command in MEASUREMENTS["lifts"].cells.items()}
    (tmp_path / "lifts.json").write_text(json.dumps({"cells": cells}))
    with pytest.raises(ValueError, match="mix states: weights"):
        targets.all_targets(Results(tmp_path))


def test_published_hands_are_counted_in_their_last_state() -> None:
    lines = list(csv.DictReader(targets.PUBLISHED.read_text().splitlines()))
    hands = {line["hand"] for line in lines}
    found = targets.published(Results(), ("accepted",))
    last = [[line for line in lines if line["hand"] == hand][-1] for hand in hands]
    assert found.value == sum(line["accepted"] == "yes" for line in last)
    assert found.told.endswith(f"of {len(hands)}")


def test_confidence_is_off_by_its_worst_tenth_with_enough_grasps(tmp_path: Path) -> None:
    bins = [{"from": 0.1, "to": 0.2, "n": 29, "predicted": 0.15, "observed": 1.0, "low": 0.9, "high": 1.0},
            {"from": 0.4, "to": 0.5, "n": 10, "predicted": 0.45, "observed": 0.6, "low": 0.3, "high": 0.9}]
    cells = {name: {**CELL, "command": command, "result": {"bins": bins if name.startswith("made") else bins[1:]}}
             for name, command in MEASUREMENTS["confidence"].cells.items()}
    (tmp_path / "confidence.json").write_text(json.dumps({"cells": cells}))
    assert targets.worst_tenth(Results(tmp_path)).told == "85 points, 58 grasps of 10 to 20 %", "twice 29, of made hands"
    bins[0]["n"] = 14
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "confidence.json").write_text(json.dumps({"cells": cells}))
    found = targets.worst_tenth(Results(tmp_path / "other"))
    assert found.value == pytest.approx(15)
    assert found.told.endswith("of 40 to 50 %"), "28 are too few to tell"


def test_half_of_the_candidates_loses_the_most_on_one_group(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from types import SimpleNamespace

    held = {"validate": (1.0, 0.99), "test": (0.95, 0.97), "hard": (0.8, 0.76)}
    monkeypatch.setattr(targets, "with_half", lambda results, where: [
        SimpleNamespace(success={"carry": (rate, 0, 1)}) for rate in held[where]])
    found = targets.lost_by_half(Results(tmp_path))
    assert found.value == pytest.approx(4)
    assert found.told == "4.0 points: 76.0 instead of 80.0 %, hard"


def test_tables_that_one_robot_cleared_are_not_those_of_both(tmp_path: Path) -> None:
    declared = MEASUREMENTS["cleared"].cells
    for robots, end in ((ROBOTS[:1], "not measured"), (ROBOTS, "reached")):
        cells = {name: {**CELL, "command": declared[name], "result": {"removed": 6, "things": 6, "picks": 6}}
                 for robot in robots for name in declared if name.startswith(robot)}
        folder = tmp_path / str(len(robots))
        folder.mkdir()
        (folder / "cleared.json").write_text(json.dumps({"cells": cells}))
        lines = {t.what: t.line(Results(folder)) for t in targets.targets()}
        assert [lines[what][5] for what in ("things cleared, six on a table", "picks for each")] == [end, end]
