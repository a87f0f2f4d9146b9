"""Results of measurements as tables read them: cells, rows of benchmarks, their state; and how rates are told."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dro_grasp.compare.metrics import success_rate
from dro_grasp.compare.rows import ALL, Row, average
from lab.measurements import MEASUREMENTS, PAPER_HANDS, SEEN_IN_PART
from lab.runner import RESULTS, code_of
from lab.studies import payload

Cell = dict[str, Any]
PROTOCOLS = ("carry", "robust", "dexgraspbench", "strict", "dro")
"""Columns, the one that asks most of a grasp first; those that a measurement does without are left out."""
HEAD = ["", "asked/returned", *(f"`{p}` [%]" for p in PROTOCOLS), "fingers (all) [%]"]


class MissingResult(Exception):
    """A table needs what was not measured."""


class Results:
    """Results of measurements, and which of them a table has looked at."""

    def __init__(self, folder: Path = RESULTS) -> None:
        self.folder, self.used = folder, {}

    def cell(self, measurement: str, name: str) -> Any:
        """What a command printed.

        Raises:
            MissingResult: It was not run as it is declared now.
        """
        path = self.folder / f"{measurement}.json"
        cells = _cells(path) if path.exists() else {}
        if cells.get(name, {}).get("command") != MEASUREMENTS[measurement].cells[name]:
            raise MissingResult(measurement)
        self.used[f"{measurement}: {name}"] = cells[name]
        return cells[name]["result"]

    def cells(self, measurement: str, ending: str = "") -> dict[str, Any]:
        """What all commands of a measurement printed whose names end so."""
        return {name: self.cell(measurement, name) for name in MEASUREMENTS[measurement].cells if name.endswith(ending)}

    def some(self, measurement: str, start: str = "") -> list[Any]:
        """What those commands printed whose names start so, of those that were run."""
        found = list[Any]()
        for name in MEASUREMENTS[measurement].cells:
            if name.startswith(start):
                with contextlib.suppress(MissingResult):
                    found.append(self.cell(measurement, name))
        return found

    def rows(self, measurement: str, start: str = "", ending: str = "") -> list[Row]:
        """Rows of `dro-grasp benchmark` of all commands whose names start and end so."""
        found = [n for n in MEASUREMENTS[measurement].cells if n.startswith(start) and n.endswith(ending)]
        return [as_row(line) for name in found for line in self.cell(measurement, name)["rows"]]


@functools.cache
def _cells(path: Path) -> dict[str, Cell]:
    return json.loads(path.read_text())["cells"]


def as_row(line: dict[str, Any]) -> Row:
    """A row as it was before it was printed."""
    return Row(**{field.name: _numbers(line[field.name]) for field in dataclasses.fields(Row)})


@dataclass(frozen=True)
class Bin:
    """Grasps of one tenth of confidence."""

    tenth: int
    n: int
    predicted: float  # mean confidence
    held: int


def confidence_bins(results: Results, in_part: bool = False) -> list[Bin]:
    """Predicted beside observed: of hands that no weights were trained on, or of objects seen in part."""
    known = tuple(map(plain, PAPER_HANDS))
    names = [name for name in MEASUREMENTS["confidence"].cells
             if (name.endswith(SEEN_IN_PART) if in_part else not name.startswith(known))]
    bins, found = [b for name in names for b in results.cell("confidence", name)["bins"]], []
    for tenth in range(10):
        own = [b for b in bins if round(10 * b["from"]) == tenth]
        if n := sum(b["n"] for b in own):
            predicted, held = (sum(b[key] * b["n"] for b in own) for key in ("predicted", "observed"))
            found.append(Bin(tenth, n, predicted / n, round(held)))
    return found


def payload_errors(results: Results) -> tuple[float, float, int, int]:
    """Median errors of stated payloads and of repeated trials [%]; how many grasps held a mass in trials, and how many none."""
    rows = [row for found in results.cells("payload").values() for row in found["rows"]]
    held = [row for row in rows if row["trials"] > payload.INTERVALS[0][0]]
    stated, again = (
        100 * statistics.median(abs(row[way] / row["trials"] - 1) for row in held) for way in (payload.WEIGHED, payload.AGAIN))
    return stated, again, len(held), len(rows) - len(held)


def with_half(results: Results, where: str) -> tuple[Row, Row]:
    """What is returned on one group of objects with all candidates, and with half of them; the mean of the paper's hands."""
    every = results.rows("hard") if where == "hard" else results.rows("headline", where, "returned")
    return average(every), average(results.rows("half", where))


def _numbers(value: Any) -> Any:
    """Nothing becomes NaN again, and the label of a protocol its name."""
    if isinstance(value, dict):
        return {key.partition("/")[0]: _numbers(v) for key, v in value.items()}
    if isinstance(value, list):
        return tuple(_numbers(v) for v in value)
    return math.nan if value is None else value


def mixed(used: dict[str, Cell]) -> list[str]:
    """In what the results of one table differ that should be of one state."""
    found = ["weights"] if len({json.dumps(cell["weights"], sort_keys=True) for cell in used.values()}) > 1 else []
    states: dict[str, set[str]] = {}
    for cell in used.values():
        for name, digest in code_of(cell).items():  # measurements rest on different parts
            states.setdefault(name, set()).add(digest)
    return found + [f"code of {name}" for name, digests in states.items() if len(digests) > 1]


def state_of(what: str, used: dict[str, Cell]) -> str:
    """The commits of what one row or table rests on, of which all has the same code and weights.

    Raises:
        ValueError: It has not.
    """
    if found := mixed(used):
        raise ValueError(f"{what} would mix states: {', '.join(found)}; run `make results` for what is stale")
    return ", ".join(sorted({cell["commit"] for cell in used.values()}))


def percent(rate: Sequence[float]) -> str:
    """Success and its interval [%]."""
    return "-" if math.isnan(rate[0]) else f"{100 * rate[0]:.1f} [{100 * rate[1]:.0f}-{100 * rate[2]:.0f}]"


def of(held: int, asked: int) -> str:
    """Success of counts and its interval [%]."""
    return percent(success_rate(held, asked))


def table(columns: Sequence[str], lines: Sequence[Sequence[object]]) -> str:
    """Markdown; a column that is empty everywhere is left out."""
    filled = [i for i, _ in enumerate(columns) if i == 0 or any(str(line[i]) for line in lines)]
    columns, lines = [columns[i] for i in filled], [[line[i] for i in filled] for line in lines]
    return "\n".join(f"|{'|'.join(map(str, line))}|" for line in (columns, ["---"] * len(columns), *lines))


def line(label: str, row: Row, *more: object) -> list[object]:
    """A row's cells: asked, returned, success, fingers that touch under `strict`, and what else is given."""
    share, everyone = row.fingers["strict"]
    rates = [percent(row.success[p]) if p in row.success else "" for p in PROTOCOLS]
    return [label, f"{row.asked}/{row.returned}", *rates, f"{100 * share:.0f} ({100 * everyone:.0f})", *more]


def plain(hand: str) -> str:
    """A hand's name without the folder of the assets."""
    return hand.removeprefix("assets/")


def select(rows: Sequence[Row], grasps: str, stage: str) -> list[Row]:
    """Rows of single hands."""
    return [row for row in rows if row.grasps == grasps and row.stage == stage and row.hand != ALL]
