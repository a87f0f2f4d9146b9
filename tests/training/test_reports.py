"""Reports of a training run on the console."""

from __future__ import annotations

import pytest

from dro_grasp.training import reports
from dro_grasp.training.reports import RunProgress, console_report


def test_a_line_now_and_then_with_the_time_that_is_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = [1000.0]
    monkeypatch.setattr(reports.time, "monotonic", lambda: clock[0])
    report = console_report("training")
    for step, seconds in ((10, 0.0), (11, 1.0), (40, 60.0), (100, 61.0)):
        clock[0] = 1000.0 + seconds
        report(RunProgress(step, 100, step / 100), {"total": 0.5})
    lines = capsys.readouterr().err.splitlines()
    assert [line.split()[1] for line in lines] == ["10/100", "40/100", "100/100"], "not within ten seconds, but at the end"
    assert lines[1].endswith("  2 min left"), "three tenths took a minute, so the other six take two"
    assert "total 0.5000" in lines[0]
