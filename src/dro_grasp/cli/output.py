"""Output of the commands: tables and messages for people, one JSON object for programs, progress on stderr."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import tyro
from rich.console import Console
from rich.table import Table

Flag = tyro.conf.FlagCreatePairsOff[bool]
"""A switch that is off by default and has no --no- form."""

stdout = Console(highlight=False, markup=False)
stderr = Console(stderr=True, highlight=False, markup=False)


def say(text: str) -> None:
    """Print one line to stdout without wrapping, so that paths stay whole."""
    stdout.print(text, soft_wrap=True)


def say_aside(text: str) -> None:
    """Print one line to stderr without wrapping."""
    stderr.print(text, soft_wrap=True)


def optional(metavar: str, default: str) -> Any:
    """Help settings of an option without a default value: its metavar, and a description of the default."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})")


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


def print_table(title: str, columns: list[str], rows: list[list[Any]], note: str = "") -> None:
    """Print a table for people."""
    table = Table(title=title, title_justify="left")
    for column in columns:
        table.add_column(column, justify="left" if column in {"name", "hand", "object", "reason", "from"} else "right")
    for row in rows:
        table.add_row(*[_cell(value) for value in row])
    stdout.print(table)
    if note:
        say(note)


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
    """A progress bar on stderr; the block calls its value with (done, total), or gets None if quiet."""
    if quiet:
        yield None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=stderr, transient=True) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
