"""How commands talk: tables and messages for people, one JSON object for programs, progress on stderr."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

if TYPE_CHECKING:
    from dro_grasp.grasps.batch import GraspBatch

stdout = Console(highlight=False, markup=False)
stderr = Console(stderr=True, highlight=False, markup=False)


def say(text: str) -> None:
    """One line on stdout, never broken: paths stay whole."""
    stdout.print(text, soft_wrap=True)


def say_aside(text: str) -> None:
    """One line on stderr, never broken."""
    stderr.print(text, soft_wrap=True)


def optional(metavar: str, default: str) -> Any:
    """How an option that may be left out is listed in --help, with what happens then."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})")


def print_json(values: dict[str, Any]) -> None:
    """One JSON object on stdout; numbers that are not finite become null."""
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
    """A table for people."""
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
    """A bar on stderr that is fed with (done, wanted); nothing when quiet."""
    if quiet:
        yield None
        return
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=stderr, transient=True) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, wanted: bar.update(task, completed=done, total=wanted)


def load_grasps(path: Path) -> GraspBatch:
    """A grasp file with at least one grasp in it.

    Raises:
        GraspFileError: No such file, a foreign one, or an empty one.
    """
    from dro_grasp.errors import GraspFileError
    from dro_grasp.grasps.batch import GraspBatch

    grasps = GraspBatch.load(path)
    if len(grasps) == 0:
        raise GraspFileError(f"{path} holds no grasp; generate again, perhaps without --only-successful")
    return grasps
