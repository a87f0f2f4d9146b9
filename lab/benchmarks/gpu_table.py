"""Everything that is told of a GPU, by one command in at most eight minutes.

What is measured is appended to a file at once, so a run that is cut off keeps its rows, and the next one measures what is
missing. Rows of other code, other weights or another card are measured anew. The parts follow each other, each in a process of
its own, the agreement of verdicts last. A row that nobody measured is blank; it is named, and the exit code is 1.

    python -m lab.benchmarks.gpu_table [--device cuda] [--minutes 8] [--record out/gpu.jsonl] [--show] [--json]

Agreement of verdicts needs development assets; `lab.benchmarks.device_trials --pack FOLDER` copies the few of them.
Two devices rehearse it in small, without a GPU: `cpu`, and `warp`, with trials by MuJoCo Warp on the processor and all else as
with `cpu`. Its kernels compile for some minutes the first time. `--show` measures nothing.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dro_grasp.devices import require_device
from dro_grasp.simulation.worlds import WARP, require_worlds
from lab.benchmarks.device import MANY, ONE, SHARES, SINGLE
from lab.benchmarks.report import emit, machine, note, options_of
from lab.measurements import STORED
from lab.runner import PACKAGE, code_hash, weights_hashes

Found = dict[str, Any]  # What a part noted under a name


@dataclass(frozen=True)
class Row:
    """A row of the table."""

    what: str
    name: str  # under which it is noted
    unit: str
    goal: float
    value: Callable[[Found], float] = lambda found: found["rate"]
    fewer: bool = False  # whether less is better


SMALL = {"cpu": "cpu", WARP: "cpu"}
"""Devices that rehearse, and where PyTorch computes with them."""
BEGUN = "begun"  # Name of what tells of which state the rows after it are
HANDS = tuple(path.stem for path in STORED)
ROWS = (
    Row("one pair, 1,024 candidates, settled, the best 64 weighed", f"{ONE}, settled", "candidates/s", 500),
    Row("64 pairs of one hand, 16 candidates each, settled, the best of each weighed", f"{MANY}, settled", "candidates/s", 500),
    Row("one grasp, four candidates, settled and weighed", f"{SINGLE}, settled", "ms", 150, lambda f: f["milliseconds"], True),
    Row("closings, allegro and duck", "closings", "1/s", 5000),
    Row("whole strict trials, the same", "whole strict trials", "1/s", 800),
    *(Row(f"synthesis, strict-valid, allegro on training objects, {share:.0%} of it confirmed", f"shard, {share:g} confirmed",
          "grasps/s", 500) for share in SHARES["gpu"]),
    *(Row(f"share of that time in which the processor confirms, {share:.0%} confirmed", f"shard, {share:g} confirmed",
          "%", 10, lambda f: 100 * f["judging"], True) for share in SHARES["gpu"]),
    Row("training, multi", "training, multi", "samples/s", 10_000),
    Row("training, paper size", "training, paper", "samples/s", 1_500),
    *(Row(f"verdicts of the processor, strict, {hand}", f"agreement, {hand}, strict", "%", 97,
          lambda f: 100 * f["same"] / f["grasps"]) for hand in HANDS),
)


def parts(device: str) -> list[tuple[list[str], list[str]]]:
    """Names that each part notes, and its command; what matters most comes first."""
    small = device in SMALL
    trials, own = ["device_trials", "--device", device], ["--device", SMALL.get(device, device)]
    predictions = [f"{name}, settled" for name in (ONE, MANY, SINGLE)]
    shards = [f"shard, {share:g} confirmed" for share in SHARES["cpu" if small else "gpu"]]
    alike = [*trials, "--worlds", "--settled", "0", "--protocols", "strict", "--num", "2" if small else "400"]
    return [
        (predictions, ["device", *own, "--only", "prediction", "--settled", "--alone", "--quick"]),
        (["closings", "whole strict trials"],
         [*trials, "--grasps", "--settled", "0", "--worlds", "2" if small else "4096"]),
        (["training, multi", "training, paper"], ["training", *own, "--quick"]),
        (shards, ["device", *own, "--only", "shards", "--alone"]),
        *(([f"agreement, {path.stem}, strict"], [*alike, "--grasps", str(path)]) for path in STORED),
    ]


def state() -> str:
    """What rows are of: code, weights and card."""
    weights = "".join(weights_hashes().values())
    return f"{code_hash(PACKAGE)} {code_hash('lab/benchmarks')} {weights} {machine()['cuda']}"


def kept(record: Path) -> Iterator[Found]:
    """Lines of a file; one that was cut off counts as nothing."""
    for line in record.read_text().splitlines() if record.is_file() else ():
        try:
            yield json.loads(line)
        except json.JSONDecodeError:
            continue


def begin(record: Path) -> None:
    """Say of which state the next rows are, where it is another than that of the last ones."""
    before = [one["state"] for one in kept(record) if one["name"] == BEGUN]
    if before[-1:] != [now := state()]:
        note(record, BEGUN, state=now)


def noted(record: Path, device: str) -> dict[str, Found]:
    """What was found on a device in the last state, the last of each name."""
    found: dict[str, Found] = {}
    for one in kept(record):
        if one["name"] == BEGUN:
            found = {}
        elif one["device"] in (device, SMALL.get(device)):
            found[one["name"]] = one
    return found


def whole(found: Found | None) -> bool:
    """Whether something was noted, of as many grasps as were asked for."""
    return found is not None and found.get("grasps", 0) >= found.get("asked", 0)


def measure(options: argparse.Namespace) -> None:
    """Run what is missing, one part after the other, until the time is over."""
    end = time.monotonic() + 60 * options.minutes
    begin(options.record)
    for names, command in parts(options.device):
        if all(whole(noted(options.record, options.device).get(name)) for name in names):
            continue
        left = end - time.monotonic()
        if left <= 0:
            print(f"no time left for {', '.join(names)}", file=sys.stderr)
            continue
        own = [sys.executable, "-m", f"lab.benchmarks.{command[0]}", *command[1:], "--record", str(options.record)]
        try:
            code = subprocess.run(own, timeout=left, stdout=subprocess.DEVNULL).returncode
        except subprocess.TimeoutExpired:
            code = "the end of the time"
        if code:
            print(f"{' '.join(command)} ended by {code}", file=sys.stderr, flush=True)


def lines(found: dict[str, Found]) -> list[list[object]]:
    """The table: what, measured or blank, unit, goal, whether it is reached, and how many grasps or samples it is of."""
    told: list[list[object]] = []
    for row in ROWS:
        if row.name not in found:
            told.append([row.what, "blank", row.unit, row.goal, "", ""])
            continue
        own = found[row.name]
        value = row.value(own)
        reached = value <= row.goal if row.fewer else value >= row.goal
        size = next((own[name] for name in ("candidates", "worlds", "grasps", "samples") if name in own), "")
        told.append([row.what, value, row.unit, row.goal, "yes" if reached else "no", size])
    return told


def missing(found: dict[str, Found], device: str) -> list[str]:
    """Names that nothing was noted under, or too little."""
    return [name for names, _ in parts(device) for name in names if not whole(found.get(name))]


def main(argv: list[str] | None = None) -> int:
    """Measure what is missing, and print all that there is; 1 if anything still is."""
    parser = options_of(__doc__)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--minutes", type=float, default=8.0, help="no part goes on after this time [min]")
    parser.add_argument("--record", type=Path, default=Path("out/gpu.jsonl"), help="file of what is found")
    parser.add_argument("--show", action="store_true", help="print what was found, and measure nothing")
    options = parser.parse_args(argv)
    if not options.show:
        require_device("cpu" if options.device in SMALL else options.device)
        require_worlds(options.device)
        measure(options)
    found = noted(options.record, options.device)
    emit(f"On {options.device}; blank: not measured", lines(found), ["what", "measured", "unit", "goal", "reached", "of"],
         {"rows": found}, options.json)
    if lacking := missing(found, options.device):
        print(f"not measured: {'; '.join(lacking)}", file=sys.stderr)
    return int(bool(lacking))


if __name__ == "__main__":
    sys.exit(main())
