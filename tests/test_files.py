"""Folders to write to, checked before the work and made with their parents."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from dro_grasp.errors import OutputError
from dro_grasp.files import check_folder, make_folder


@pytest.mark.parametrize("name", ["run", "runs/main/motion"])
def test_a_folder_is_checked_without_a_trace_and_made_with_its_parents(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert check_folder(name) == Path(name)
    assert list(tmp_path.iterdir()) == []
    assert make_folder(name) == make_folder(tmp_path / name).relative_to(tmp_path)
    assert (tmp_path / name).is_dir()


@pytest.mark.parametrize("name", ["file", "file/run", "file/runs/main"])
def test_a_file_is_no_folder_and_holds_none(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").write_text("kept")
    for call in (check_folder, make_folder):
        with pytest.raises(OutputError, match="file is a file"):
            call(tmp_path / name)
    assert (tmp_path / "file").read_text() == "kept"


def test_a_folder_above_that_is_read_only_is_named_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The superuser may write anywhere, so the system's answer is replaced."""
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path)
    with pytest.raises(OutputError, match=f"into {tmp_path}: no permission"):
        make_folder(tmp_path / "runs" / "main")
    assert list(tmp_path.iterdir()) == []
