"""Whether results of earlier code are those of the present code: one command of each measurement is run with both.

    python -m lab.confirm [NAME ...] [--workers 2]

A change of code makes results stale, whether it changes any or not. Here the quickest command of a measurement is run twice on
one machine: at the commit of its result, and now. (Its numbers themselves may differ between machines, which round otherwise.)
If all numbers but times come out the same, the measurement's results count as those of the present code, too, and each keeps
where it was measured and where that was confirmed. If any differs, all stay stale. Times are never confirmed, nor are results
of other commands or weights.
"""

from __future__ import annotations

import argparse
import contextlib
import datetime
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from dro_grasp.provenance import commit
from lab.benchmarks.report import ROOT
from lab.measurements import MEASUREMENTS, PREPARED
from lab.reading import mixed
from lab.runner import Job, at_hand, code_of, differing, git, jobs_of, keep, prepare, read, uncommitted, words

TIMES = ("second", "[s]", "[ms]", "time", "hour", "speed", "cpu")
"""What names of times and speeds contain, in small letters."""
ROUNDING = 1e-9
"""Largest difference of numbers that are the same, over the larger one [1]."""


def main(argv: list[str] | None = None) -> int:
    """Confirm what is named, or all that is stale by its code alone; 1 if anything came out otherwise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(MEASUREMENTS)}; all by default")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="commands at a time")
    options = parser.parse_args(argv)
    if unknown := [name for name in options.names if name not in MEASUREMENTS]:
        parser.error(f"there is no measurement {unknown[0]}; there are {', '.join(MEASUREMENTS)}")
    if changed := uncommitted():
        parser.error(f"uncommitted changes would be confirmed as if they were a commit: {', '.join(changed[:5])}; commit them")
    asked = {name: jobs for name in options.names or MEASUREMENTS if (jobs := confirmable(name))}
    if not asked:
        print("nothing is stale by its code alone")
    prepare([job for jobs in asked.values() for job in jobs])
    with ThreadPoolExecutor(options.workers) as pool:
        return int(not all([*pool.map(lambda name: confirmed(name, asked[name], options.workers > 1), asked)]))


def confirmable(name: str) -> list[Job]:
    """The commands of a measurement whose results differ from the present state by their code alone; none if any is fresh."""
    measurement, cells = MEASUREMENTS[name], read(name)["cells"]
    if measurement.alone or not at_hand(measurement) or not commit():
        return []
    jobs = [job for job in jobs_of(name, measurement) if job.cell in cells]
    kept = [cells[job.cell] for job in jobs]
    stale = [bool(differing(code_of(cell), job.state["code"])) for cell, job in zip(kept, jobs, strict=True)]
    same = all(cell["command"] == job.command and cell["weights"] == job.state["weights"]
               for cell, job in zip(kept, jobs, strict=True))
    one = not mixed({job.cell: cell for job, cell in zip(jobs, kept, strict=True)})
    known = all(cell["commit"] != "unknown" for cell in kept)
    return jobs if kept and all(stale) and same and one and known else []


def confirmed(name: str, jobs: list[Job], beside: bool) -> bool:
    """Run the quickest command with both states of the code, and say and keep what came of it."""
    cells, now = read(name)["cells"], commit().removesuffix("+")
    quickest = min(jobs, key=lambda job: cells[job.cell]["seconds"])
    before = cells[quickest.cell]["commit"]
    try:
        with checkout(before) as folder:
            old = printed(quickest.command, folder, beside)
        new = printed(quickest.command, ROOT, beside)
    except (subprocess.CalledProcessError, ValueError, IndexError) as error:
        print(f"{name}: {quickest.cell} failed: {getattr(error, 'stderr', '') or error}", flush=True)
        return False
    if other := differences(old, new):
        print(f"{name}: {quickest.cell} comes out otherwise than at {before}: {', '.join(other[:3])}", flush=True)
        return False
    for job in jobs:
        keep(job, cells[job.cell] | {"confirmed": {
            "by": quickest.cell, "commit": now, "date": f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d}",
            "code": job.state["code"]}})
    print(f"{name}: {quickest.cell} comes out the same as at {before}; all {len(jobs)} results count as the present code's",
          flush=True)
    return True


@contextlib.contextmanager
def checkout(state: str) -> Iterator[Path]:
    """The files of a commit in a folder of their own, with the prepared inputs of the present one."""
    with tempfile.TemporaryDirectory() as holder:
        folder = Path(holder) / "checkout"
        git("worktree", "add", "--detach", str(folder), state)
        try:
            (folder / PREPARED).parent.mkdir(exist_ok=True)
            (folder / PREPARED).symlink_to(ROOT / PREPARED)
            yield folder
        finally:
            git("worktree", "remove", "--force", str(folder))


def printed(command: str, folder: Path, beside: bool) -> Any:
    """What a command prints in a checkout; with another beside it, each has one thread."""
    environment = {**os.environ, "PYTHONPATH": str(folder / "src"), **({"OMP_NUM_THREADS": "1"} if beside else {})}
    done = subprocess.run(words(command), cwd=folder, env=environment, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def differences(old: Any, new: Any, where: str = "result") -> list[str]:
    """Where two results differ, but for times."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        names = [name for name in dict.fromkeys((*old, *new)) if not any(word in str(name).lower() for word in TIMES)]
        return [text for name in names for text in (
            differences(old[name], new[name], f"{where}.{name}") if name in old and name in new else [f"{where}.{name}"])]
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        return [text for i, pair in enumerate(zip(old, new, strict=True)) for text in differences(*pair, f"{where}[{i}]")]
    if isinstance(old, int | float) and isinstance(new, int | float):
        same = math.isclose(old, new, rel_tol=ROUNDING, abs_tol=0.0) and isinstance(old, bool) == isinstance(new, bool)
    else:
        same = old == new
    return [] if same else [f"{where} {old!r} -> {new!r}"]


if __name__ == "__main__":
    sys.exit(main())
