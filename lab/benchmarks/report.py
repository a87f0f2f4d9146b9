"""Output of every benchmark: one table for people, or one JSON object for programs."""

from __future__ import annotations

import argparse
import json
import os
import platform
from collections.abc import Collection, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dro_grasp.cli.output import print_json
from dro_grasp.compare.metrics import wilson_interval
from dro_grasp.provenance import commit

ROOT = Path(__file__).resolve().parents[2]
"""Folder of the repository."""


def machine() -> dict[str, str | int]:
    """Processor, cores, threads, library versions and commit: a time means nothing without them."""
    return {
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "mujoco": _version("mujoco"),
        "cuda": torch.cuda.get_device_name() if torch.cuda.is_available() else "none",
        "commit": commit() or "unknown",
    }


def options_of(docstring: str | None) -> argparse.ArgumentParser:
    """A parser of a benchmark's options, which explains it by its docstring and knows --json."""
    parser = argparse.ArgumentParser(description=docstring, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    return parser


def emit(
    title: str,
    rows: Sequence[Sequence[object]],
    columns: Sequence[str],
    json_object: Mapping[str, object],
    as_json: bool,
) -> None:
    """Print the result: exactly one JSON object on standard output, or a table headed by the machine.

    Args:
        title: The measurement and its sample.
        rows: Cells of the table; floats are shown with three significant digits.
        columns: Headings, with units in [brackets].
        json_object: The keys that the project's targets name; the machine is added.
        as_json: Print the object instead of the table.
    """
    if as_json:
        print_json({**json_object, "machine": machine()})
        return
    cells = [list(columns), *[[_cell(value) for value in row] for row in rows]]
    widths = [max(len(row[i]) for row in cells) for i in range(len(columns))]
    print(title)
    print(", ".join(f"{key} {value}" for key, value in machine().items()))
    for i, row in enumerate(cells):
        padded = [row[0].ljust(widths[0]), *[c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True)]]
        print("  ".join(padded))
        if i == 0:
            print("  ".join("-" * width for width in widths))
    for key, value in json_object.items():
        if isinstance(value, int | float | str):
            print(f"{key}: {_cell(value)}")


def note(path: Path | None, name: str, **values: object) -> None:
    """Append a result to a file of JSON lines, if one is given: whatever ends the run later, it is kept."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        cut_off = path.is_file() and not path.read_bytes().endswith(b"\n")
        with path.open("a") as file:
            file.write("\n" * cut_off + json.dumps({"name": name, **values, "machine": machine()}) + "\n")


def rate(held: Collection[bool] | np.ndarray | Tensor, asked: int | None = None) -> str:
    """Success in per cent of the grasps that were asked for, or else of those that there are, with its 95 % interval."""
    success, total = int(sum(map(bool, held))), len(held) if asked is None else asked
    low, high = wilson_interval(success, total)
    return f"{100 * success / total:.1f} [{100 * low:.0f}-{100 * high:.0f}]"


def _cell(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
