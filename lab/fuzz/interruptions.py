"""Runs that are stopped in the middle and started again, against the same runs undisturbed.

Each command is stopped at shares of the time that it takes undisturbed: by Ctrl-C, which reaches all of its processes; by
killing it with its processes; or, where it has workers, by killing the busiest one, after which it must finish by itself. A
table says how the command ended, how many lines it printed on being stopped, how many half-written files were left where a
reader would find them, and whether the rerun gives the same grasps or weights, bit by bit. `onboard` works by the clock, so
only its ending is compared.

    python -m lab.fuzz.interruptions [--json] [--shares 0.3 0.7] [--jobs generate synthesize train onboard]
"""

from __future__ import annotations

import hashlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from safetensors.torch import load_file

from dro_grasp.grasps.batch import GraspBatch
from lab.benchmarks.report import emit, options_of

COMMAND = (sys.executable, "-m", "dro_grasp")
"""The command under test."""


@dataclass(frozen=True)
class Job:
    """A command that is stopped; FOLDER stands for the folder of its results."""

    arguments: Sequence[str]
    result: Callable[[Path], str]
    """Hash of what the folder holds in the end."""
    workers: bool = False
    """Whether it has worker processes."""


def grasps_in(folder: Path) -> str:
    """Hash of all grasps, file by file."""
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*.parquet")):
        grasps = GraspBatch.load(path)
        digest.update(str(path.relative_to(folder)).encode() + grasps.joints.numpy().tobytes())
        digest.update(grasps.T_object_wrist.numpy().tobytes())
    return digest.hexdigest()[:12]


def weights_in(folder: Path) -> str:
    """Hash of the weights."""
    tensors = load_file(folder / "weights.safetensors")
    return hashlib.sha256(b"".join(tensors[name].numpy().tobytes() for name in sorted(tensors))).hexdigest()[:12]


def ending_of(folder: Path) -> str:
    """Whether there is a report."""
    return "report" if (folder / "report.html").is_file() else "no report"


def jobs(bundle: Path) -> dict[str, Job]:
    """The commands, small ones."""
    pair = ("--hand", "gripper3", "--object", "can")
    train = ("train", "--bundle", str(bundle), "--run-folder", "FOLDER/run", "--output", "FOLDER/weights.safetensors",
             "--preset", "slim", "--steps", "40")
    return {
        "generate": Job(("generate", *pair, "--num", "8", "--output", "FOLDER/g.parquet"), grasps_in),
        "synthesize": Job(("synthesize", *pair, "torus", "--grasps", "16", "--output", "FOLDER"), grasps_in, workers=True),
        "train": Job(train, weights_in),
        "onboard": Job(("onboard", "gripper3", "--output", "FOLDER", "--objects", "torus", "--held-out", "can", "--num", "4",
                        "--minutes", "0.5"), ending_of),
    }


def start(job: Job, folder: Path) -> subprocess.Popen[str]:
    """The command in a process group of its own, as a shell starts it."""
    arguments = [argument.replace("FOLDER", str(folder)) for argument in job.arguments]
    return subprocess.Popen([*COMMAND, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, process_group=0)


def busiest_child(process: int) -> int | None:
    """The child of a process with the most CPU time."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == process:
            found.append((int(fields[11]) + int(fields[12]), int(stat.parent.name)))
    return max(found)[1] if found else None


def stop(process: subprocess.Popen[str], way: str) -> tuple[int, list[str]]:
    """Stop a command: its exit code, and what it says then."""
    if way == "a worker killed":
        child = busiest_child(process.pid)
        if child is not None:
            os.kill(child, signal.SIGKILL)
    else:
        os.killpg(process.pid, signal.SIGINT if way == "Ctrl-C" else signal.SIGKILL)
    _, told = process.communicate()
    lines = told.replace("\r", "\n").splitlines()
    return process.returncode, [line for line in lines if "stopped" in line or "Traceback" in line or "Error" in line]


def measure(name: str, job: Job, shares: Sequence[float], root: Path) -> list[list[object]]:
    """Rows of a command."""
    begin = time.perf_counter()
    undisturbed = root / name
    undisturbed.mkdir()
    process = start(job, undisturbed)
    _, told = process.communicate()
    seconds, expected = time.perf_counter() - begin, job.result(undisturbed)
    if process.returncode:
        raise SystemExit(f"{name} failed undisturbed: {told[-500:]}")
    rows: list[list[object]] = []
    for way in ("Ctrl-C", "killed", *(("a worker killed",) if job.workers else ())):
        for share in shares:
            folder = root / f"{name}-{way}-{share}".replace(" ", "_")
            folder.mkdir()
            process = start(job, folder)
            time.sleep(share * seconds)
            code, lines = stop(process, way)
            halves = [p.name for p in folder.rglob("*") if p.suffix == ".part" and not p.name.startswith(".")]
            again = 0
            if code:
                rerun = start(job, folder)
                rerun.communicate()
                again = rerun.returncode
            same = "yes" if again == 0 and job.result(folder) == expected else "no"
            rows.append([name, way, f"{share:.0%} of {seconds:.0f} s", code, len(lines), len(halves), again, same])
            print(*rows[-1], *lines, file=sys.stderr, flush=True)
            shutil.rmtree(folder)
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse, run, print; 1 if a rerun differs."""
    parser = options_of(__doc__)
    parser.add_argument("--shares", type=float, nargs="+", default=[0.3, 0.7])
    parser.add_argument("--jobs", nargs="+", default=["generate", "synthesize", "train", "onboard"])
    args = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="interruptions-") as root:
        data, bundle = Path(root) / "data", Path(root) / "bundle.safetensors"
        if "train" in args.jobs:
            make = ("synthesize", "--hand", "gripper3", "--object", "can", "--grasps", "8", "--output", str(data))
            for command in (make, ("dataset", "bundle", str(data), "--output", str(bundle))):
                subprocess.run([*COMMAND, *command], check=True, capture_output=True)
        every = jobs(bundle)
        rows = [row for name in args.jobs for row in measure(name, every[name], args.shares, Path(root))]
    columns = ["command", "stopped", "at", "exit code", "lines", "half files", "rerun", "same result"]
    values = {"rows": [dict(zip(columns, row, strict=True)) for row in rows]}
    emit("commands stopped and started again", rows, columns, values, args.json)
    return int(any(row[-1] == "no" for row in rows))


if __name__ == "__main__":
    sys.exit(main())
