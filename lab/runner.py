"""Run what is declared in `lab.measurements`, what is missing or older than its code only, and keep the results as data.

    python -m lab.runner [NAME ...] [--stale] [--workers 2] [--again]

Each measurement has one file in lab/results: its commands, what they printed, and of which state. A command whose result is
there, of the same command, code and weights, is not run again; interrupting loses what runs at the moment. Code counts by its
syntax without docstrings and comments, so that a better sentence makes nothing stale. With uncommitted changes to what is
measured nothing runs. On a copy without git, as on a machine with a GPU, the commit is `unknown` and that hash alone says of
which code a result is: carry its file back to lab/results.
"""

from __future__ import annotations

import argparse
import ast
import datetime
import functools
import hashlib
import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn

from dro_grasp.files import replacing
from dro_grasp.provenance import commit
from lab.benchmarks.report import ROOT, machine
from lab.measurements import CORE, MEASUREMENTS, PREPARATIONS, PREPARED, Measurement

RESULTS = ROOT / "lab" / "results"
"""Folder of the results."""
PACKAGE = "src/dro_grasp"
WEIGHTS = f"{PACKAGE}/network/weights"
USUAL = 60.0
"""Time of a command that never ran, for the time that is left [s]."""
LINES = 12
"""Last lines of a command that failed, which are shown."""


@dataclass(frozen=True)
class Job:
    """One command of a measurement."""

    measurement: str
    cell: str
    command: str
    state: dict[str, dict[str, str]]


def main(argv: list[str] | None = None) -> int:
    """Run what is named, or everything; 1 if a command failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(MEASUREMENTS)}; all by default")
    parser.add_argument("--stale", action="store_true", help="only say what is missing or older than its code")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="commands at a time")
    parser.add_argument("--again", action="store_true", help="run also what is there")
    options = parser.parse_args(argv)
    if unknown := [name for name in options.names if name not in MEASUREMENTS]:
        parser.error(f"there is no measurement {unknown[0]}; there are {', '.join(MEASUREMENTS)}")
    chosen = {name: MEASUREMENTS[name] for name in options.names or MEASUREMENTS}
    if options.stale:
        return tell_stale(chosen)
    if changed := uncommitted():
        parser.error(f"uncommitted changes would be measured as if they were a commit: {', '.join(changed[:5])}; commit them")
    jobs = [job for name, m in chosen.items() if at_hand(m) for job in jobs_of(name, m) if options.again or reason(job)]
    if not jobs:
        print("nothing is missing or older than its code")
    return run(jobs, options.workers)


def jobs_of(name: str, measurement: Measurement) -> Iterator[Job]:
    """The commands of a measurement, with the state that they would measure now."""
    for cell, command in measurement.cells.items():
        parts = [*(f"{PACKAGE}/{part}" for part in (*CORE, *measurement.wings)), *named_code(command)]
        yield Job(name, cell, command, {"code": {part: code_hash(part) for part in parts}, "weights": weights_hashes()})


def at_hand(measurement: Measurement) -> bool:
    """Whether the machine has what the measurement needs."""
    if measurement.needs and not (ROOT / measurement.needs).exists():
        return False
    if measurement.device == "cpu":
        return True
    import torch

    return torch.cuda.is_available()


def reason(job: Job) -> str:
    """Why a command has to run; empty if its result is there."""
    kept = read(job.measurement)["cells"].get(job.cell)
    if kept is None:
        return "missing"
    if kept["command"] != job.command:
        return "another command"
    parts = [*differing(code_of(kept), job.state["code"]), *differing(kept["weights"], job.state["weights"])]
    return f"changed since: {', '.join(parts)}" if parts else ""


def code_of(cell: Mapping[str, Any]) -> dict[str, str]:
    """Hashes of the code that a result is of: by its measurement, or by a later confirmation (`lab.confirm`)."""
    return cell.get("confirmed", cell)["code"]


def differing(old: Mapping[str, str], new: Mapping[str, str]) -> list[str]:
    """Names whose hashes differ."""
    return sorted(name for name in {*old, *new} if old.get(name) != new.get(name))


def tell_stale(chosen: Mapping[str, Measurement]) -> int:
    """Say of each measurement what is missing or stale; 1 if anything is that the machine could measure."""
    stale = False
    for name, measurement in chosen.items():
        reasons = [why for job in jobs_of(name, measurement) if (why := reason(job))]
        note = "" if at_hand(measurement) else f" (needs {measurement.needs or measurement.device})"
        print(f"{name}: {f'{len(reasons)} of {len(measurement.cells)} commands, {reasons[0]}' if reasons else 'fresh'}{note}")
        stale |= bool(reasons) and at_hand(measurement)
    return int(stale)


def run(jobs: list[Job], workers: int) -> int:
    """Run commands, those that need the machine for themselves last; 1 if one failed."""
    failed = 0
    prepare(jobs)
    together = [job for job in jobs if not MEASUREMENTS[job.measurement].alone]
    columns = ("{task.description}", BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), "{task.fields[left]}")
    with Progress(*columns, refresh_per_second=1, disable=not jobs) as progress:
        task, left = progress.add_task("measuring", total=len(jobs), left=""), sum(map(expected, jobs))
        for group, count in ((together, workers), ([job for job in jobs if job not in together], 1)):
            for job, error in finished(group, count):
                failed += bool(error)
                left -= expected(job)
                progress.print(f"{job.measurement}: {job.cell}: {error or 'done'}", markup=False)
                progress.update(task, advance=1, left=f"about {max(0.0, left) / 60 / count:.0f} min left")
    return int(failed > 0)


def finished(jobs: list[Job], workers: int) -> Iterator[tuple[Job, str]]:
    """Each command when it has ended, and why it failed; results are written before."""
    with ThreadPoolExecutor(workers) as pool:
        waiting: dict[Future[dict[str, Any]], Job] = {pool.submit(measure, job, workers > 1): job for job in jobs}
        try:
            while waiting:
                for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                    job, error = waiting.pop(future), ""
                    try:
                        keep(job, future.result())
                    except (subprocess.CalledProcessError, ValueError, IndexError) as problem:  # IndexError: it printed nothing
                        error = "\n".join((getattr(problem, "stderr", "") or str(problem)).splitlines()[-LINES:])
                    yield job, error or ""
        except BaseException:
            pool.shutdown(cancel_futures=True, wait=False)
            raise


def measure(job: Job, beside: bool) -> dict[str, Any]:
    """Run a command and describe its state; with another beside it, each has one thread.

    Only results differ from the commit, as `main` refuses other changes.
    """
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), **({"OMP_NUM_THREADS": "1"} if beside else {})}
    begin, load, day = time.perf_counter(), os.getloadavg()[0], datetime.datetime.now(datetime.UTC)
    state = commit().removesuffix("+") or "unknown"  # while it runs, another may come
    done = subprocess.run(words(job.command), cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
    where = {key: value for key, value in machine().items() if key != "commit"}
    return {
        "command": job.command, "commit": state, **job.state, "machine": where,
        "date": day.strftime("%Y-%m-%d"), "load": round(load, 1), "seconds": round(time.perf_counter() - begin, 1),
        "inputs": {name: file_hash(ROOT / PREPARED / name) for name in PREPARATIONS if f"{PREPARED}/{name}" in job.command
                   and (ROOT / PREPARED / name).is_file()},
        "result": json.loads(done.stdout.splitlines()[-1]),
    }


def prepare(jobs: list[Job]) -> None:
    """Make what the commands need and the folder lacks."""
    (ROOT / PREPARED).mkdir(parents=True, exist_ok=True)
    for name, command in PREPARATIONS.items():
        if any(f"{PREPARED}/{name}" in job.command for job in jobs) and not (ROOT / PREPARED / name).exists():
            subprocess.run(words(command), cwd=ROOT, check=True)


def keep(job: Job, cell: dict[str, Any]) -> None:
    """Add a result to its measurement's file, one line a command; commands that are declared no more leave."""
    declared = MEASUREMENTS[job.measurement]
    cells = {**read(job.measurement)["cells"], job.cell: cell}
    lines = [f"  {json.dumps(name)}: {json.dumps(cells[name])}" for name in declared.cells if name in cells]
    RESULTS.mkdir(exist_ok=True)
    with replacing(RESULTS / f"{job.measurement}.json") as temporary:
        temporary.write_text(f'{{"title": {json.dumps(declared.title)}, "cells": {{\n' + ",\n".join(lines) + "\n}}\n")


def read(name: str) -> dict[str, Any]:
    """What is kept of a measurement."""
    path = RESULTS / f"{name}.json"
    return json.loads(path.read_text()) if path.exists() else {"cells": {}}


def expected(job: Job) -> float:
    """Time that the command took before [s]."""
    return read(job.measurement)["cells"].get(job.cell, {}).get("seconds", USUAL)


def words(command: str) -> list[str]:
    """The command for this interpreter."""
    first, *others = shlex.split(command)
    return [sys.executable, *(["-m", "dro_grasp"] if first == "dro-grasp" else []), *others]


def named_code(command: str) -> list[str]:
    """Files of the command line and of the laboratory that a command names."""
    first, *others = shlex.split(command)
    found = [f"{PACKAGE}/cli/{others[0]}.py"] if first == "dro-grasp" else []
    for word in others:
        if word.startswith("lab."):
            path = word.partition(":")[0].replace(".", "/")
            found.append(path if (ROOT / path).is_dir() else f"{path}.py")
    return found


@functools.cache
def code_hash(part: str) -> str:
    """Hash of the syntax of a file or of all files in a folder, without docstrings and comments."""
    path, digest = ROOT / part, hashlib.sha256()
    for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
        digest.update(str(file.relative_to(ROOT)).encode())
        digest.update(told(without_docstrings(ast.parse(file.read_text()))).encode())
    return digest.hexdigest()[:12]


def without_docstrings(tree: ast.Module) -> ast.Module:
    """The tree without strings that stand alone."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [line for line in body if not is_text(line)]  # type: ignore[attr-defined]
    return tree


def told(syntax: object) -> str:
    """A syntax tree in words that are the same in each version of Python: more fields or texts of some are empty."""
    if isinstance(syntax, list):
        return f"[{', '.join(map(told, syntax))}]"
    if isinstance(syntax, ast.JoinedStr):
        syntax = ast.JoinedStr([part for part in syntax.values if told(part) != told(ast.Constant(""))])
    if isinstance(syntax, ast.AST):
        fields = (f"{name}={told(value)}" for name, value in ast.iter_fields(syntax) if value not in (None, []))
        return f"{type(syntax).__name__}({', '.join(fields)})"
    return ascii(syntax)


def is_text(line: ast.stmt) -> bool:
    """Whether a statement is a string alone."""
    return isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant) and isinstance(line.value.value, str)


@functools.cache
def weights_hashes() -> dict[str, str]:
    """Hashes of the weights that ship, by file."""
    return {str(path.relative_to(ROOT / WEIGHTS)): file_hash(path) for path in sorted((ROOT / WEIGHTS).rglob("*.safetensors"))}


def file_hash(path: Path) -> str:
    """First characters of the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]


def git(*arguments: str) -> str:
    """What git prints."""
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout


def uncommitted() -> list[str]:
    """Files of code, data and weights that differ from the commit, if there is one."""
    if not commit():
        return []
    lines = git("status", "--porcelain", "--", "src", "lab", "data").splitlines()
    return [line[3:] for line in lines if not line[3:].startswith(("lab/results", "lab/notebook"))]


if __name__ == "__main__":
    sys.exit(main())
