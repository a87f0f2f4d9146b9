"""Time, memory and files of `dataset merge` on synthetic data sets of growing size.

    python -m lab.benchmarks.merging [--rows 100000 1000000] [--json]

Each data set holds pairs of one hand with 1,000 grasps each, drawn at random, in two shards. Of every fifth pair, one
shard is in a second data set too, so that near-duplicates are sought. The merge runs in a process of its own.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import torch

from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.training.data.engine.shards import Shard, Yield, notes_of
from lab.benchmarks.report import emit
from tests.helpers.tiny_bundle import made_up_grasps

HAND = "allegro"
"""Hand of all grasps, with 16 joints."""
SHARD = 500
"""Grasps of a shard."""


def fill(folder: Path, hand: Hand, rows: int) -> tuple[Path, Path]:
    """Two data sets that together hold so many different grasps; the second has a fifth of the first's pairs, in part."""
    first, second = folder / "first", folder / "second"
    count = torch.arange(SHARD) / SHARD
    for pair in range(rows // (2 * SHARD)):
        name = f"object{pair:05d}"
        for number in range(2):
            grasps = made_up_grasps(
                hand, name, SHARD, seed=2 * pair + number, provenance=f"synthesis 1, seed {pair}", energy=count,
                success=torch.ones(SHARD, dtype=torch.bool), protocol=("strict/1",) * SHARD, displacement=count / 100,
                rotation=count / 7, penetration=count / 300,
                extra={"reason": [""] * SHARD, "contact_links": [[hand.tree.link_names[-1]] * 3] * SHARD})
            payload = grasps.to_bytes(notes_of(Yield(candidates=2 * SHARD, valid=SHARD, cpu_seconds=60.0)))
            for data in (first, second) if number == 0 and pair % 5 == 0 else (first,):
                Shard(hand.name, name, number).save(payload, data)
    return first, second


def merged(inputs: tuple[Path, Path], output: Path) -> tuple[float, float, int]:
    """CPU time [s], time [s] and largest resident set [bytes] of the command."""
    begin, process = time.perf_counter(), os.fork()
    if process == 0:
        with open(os.devnull, "w") as null:
            os.dup2(null.fileno(), 1)
        command = ["-m", "dro_grasp", "dataset", "merge", *map(str, inputs), "--output", str(output)]
        os.execv(sys.executable, [sys.executable, *command])
    _, status, used = os.wait4(process, 0)
    if status:
        raise SystemExit("the merge failed")
    return used.ru_utime + used.ru_stime, time.perf_counter() - begin, used.ru_maxrss * 1024


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, nargs="+", default=[100_000, 1_000_000])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    hand, rows = load_hand(HAND), []
    for count in options.rows:
        with tempfile.TemporaryDirectory(prefix="merging-") as name:
            output = Path(name) / "out"
            cpu, seconds, memory = merged(fill(Path(name), hand, count), output)
            sizes = [path.stat().st_size for path in sorted(output.glob("*.parquet"))]
        rows.append([count, cpu, seconds, memory / 1e6, len(sizes), max(sizes) / 1e6, sum(sizes) / 1e6])
    columns = ["grasps", "processor time [s]", "time [s]", "peak memory [MB]", "files", "largest [MB]", "all [MB]"]
    emit(f"dataset merge, {HAND}", rows, columns,
         {str(row[0]): dict(zip(columns[1:], row[1:], strict=True)) for row in rows}, options.json)


if __name__ == "__main__":
    main()
