"""Output of the commands: tables and messages for people, one JSON object for programs, progress on stderr."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from dro_grasp.cli.switches import in_switches
from dro_grasp.errors import OutputError
from dro_grasp.files import check_folder

if TYPE_CHECKING:
    from dro_grasp.hands.description.loader import Description

stdout = Console(highlight=False, markup=False, emoji=False)
stderr = Console(stderr=True, highlight=False, markup=False, emoji=False)
endless = Console(highlight=False, markup=False, emoji=False, width=10_000)  # for tables in files and pipes: endless lines


NOTHING = ("", "-")  # Cells without a value
SHORT = 12  # Letters of names and sources up to which they are not broken


def say(text: str) -> None:
    """Print one line to stdout without wrapping, so that paths stay whole."""
    stdout.print(in_switches(text), soft_wrap=True)


def say_file(what: str, path: object, aside: bool = False) -> None:
    """Print where a file is, on stdout or on stderr; a name that reads like an option stays as it is."""
    (stderr if aside else stdout).print(f"{what}: {path}", soft_wrap=True)


def say_aside(text: str) -> None:
    """Print one line to stderr without wrapping."""
    stderr.print(in_switches(text), soft_wrap=True)


def folder_for(path: Path, suffix: str, objects: int) -> Path:
    """The folder for a file of each object; an OutputError where the path is the name of such a file."""
    if path.suffix.lower() == suffix and not path.is_dir():
        raise OutputError(f"{path} is the name of a file; for {objects} object{'s' if objects > 1 else ''} give that of a "
                          f"folder, such as {path.with_suffix('')}")
    return check_folder(path)


def say_doubts(description: Description | None) -> None:
    """Print to stderr, in a few lines, what is doubtful in a hand's file."""
    from dro_grasp.hands.doubts import doubts

    if description is not None:
        for line in doubts(description):
            say_aside(f"hand {description.name}: {line}")


def print_json(values: dict[str, Any]) -> None:
    """Print one JSON object to stdout; numbers that are not finite become null."""
    print(json.dumps(_plain(values)))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def print_result(
    as_json: bool, values: dict[str, Any], title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]], *notes: str
) -> None:
    """Print the values as one JSON object for programs, or the rows as a table and the notes under it for people."""
    if as_json:
        print_json(values)
        return
    print_table(title, columns, rows)
    for note in filter(None, notes):
        say(note)


def print_report(report: Any, picture: Path | None, as_json: bool) -> None:
    """Print a check's report, as one JSON object or in its lines, and where its picture is."""
    if as_json:
        print_json({**report.to_dict(), "picture": None if picture is None else str(picture)})
        return
    for line in report.lines():
        say(line)
    if picture is not None:
        say_file("picture", picture)


def records(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> list[dict[str, Any]]:
    """The rows of a table for JSON."""
    return [dict(zip(columns, row, strict=True)) for row in rows]


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print a table for people; columns that say nothing in any row are left out."""
    cells = [[_cell(value) for value in row] for row in rows]
    told = [not cells or any(row[i] not in NOTHING for row in cells) for i in range(len(columns))]
    table = Table(title=title, title_justify="left")
    for i, column in compress(enumerate(columns), told):
        words = column in {"name", "hand", "object", "reason", "from"}
        short = column in {"name", "hand", "origin"} and all(len(row[i]) <= SHORT for row in cells)
        table.add_column(column, overflow="fold", justify="left" if words else "right", no_wrap=short)
    for row in cells:
        table.add_row(*compress(row, told))
    (stdout if stdout.is_terminal else endless).print(table)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return "-" if not math.isfinite(value) else f"{value:.4g}"
    return str(value)


@contextmanager
def progress_bar(title: str, quiet: bool) -> Iterator[Callable[[int, int], None] | None]:
    """A progress bar on stderr, if that is a terminal; the block calls its value with (done, total), or gets None if quiet."""
    if quiet or not stderr.is_interactive:
        yield None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=stderr, transient=True) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
