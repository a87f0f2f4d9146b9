"""The counts of docs/data-card.md, from the files themselves.

Run it as `python -m lab.benchmarks.data_card [data/grasps] [--pictures docs/pictures] [--json]`.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from pathlib import Path

from dro_grasp.compare.rows import finger_contact
from dro_grasp.training.data.collections.collection import read_collection
from dro_grasp.training.data.collections.coverage import measure_coverage
from dro_grasp.training.data.collections.report import charts, grasps_drawn
from dro_grasp.training.data.engine.shards import Yield
from lab.benchmarks.report import ROOT, emit

PICTURED = "assets-shadowhand.parquet"
"""The hand of the pictures."""
COLUMNS = ("hand", "grasps", "train", "few_shot", "validate", "objects", "fewest", "without", "valid of evaluated [%]",
           "per CPU-hour", "diversity", "wrist", "joints", "all six half-axes [%]", "fingers [%]", "all fingers [%]", "kB")
"""Headings of the table."""


def row(path: Path) -> list[str]:
    """One file's counts."""
    (hand,) = measure_coverage(read_collection(path))
    made: Yield = hand.yields
    counts = [p.grasps for p in hand.pairs]
    splits = Counter(hand.grasps.split)
    touching = finger_contact(hand.grasps.fingers_in_contact, len(hand.hand.fingers))
    cells = [hand.grasps.hand, len(hand.grasps), splits["train"], splits["few_shot"], splits["validate"], len(counts),
             min(counts), sum(c == 0 for c in counts), f"{100 * made.valid / max(1, made.evaluated):.0f}",
             f"{made.per_cpu_hour:,.0f}", *(f"{v:.3f}" for v in hand.diversity.values()),
             f"{100 * sum(min(p.half_axes) > 0 for p in hand.pairs) / len(hand.pairs):.0f}",
             *("-" if math.isnan(touching[0]) else f"{100 * share:.0f}" for share in touching), path.stat().st_size // 1000]
    return [f"{c:,}" if isinstance(c, int) else c for c in cells]


def main() -> None:
    """Print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=ROOT / "data" / "grasps", help="merged files")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of one hand")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    folder = options.folder
    if options.pictures is not None:
        (hand,) = measure_coverage(read_collection(folder / PICTURED))
        (options.pictures / "data-charts.png").write_bytes(charts(hand))
        (options.pictures / "data-grasps.png").write_bytes(grasps_drawn(hand))
    files = sorted(folder.glob("*.parquet"))
    grasps, size = sum(len(p.grasps) for p in read_collection(folder)), sum(path.stat().st_size for path in files)
    emit(f"{grasps:,} grasps, {size / 1e6:.1f} MB", rows := [row(path) for path in files], COLUMNS,
         {"rows": [dict(zip(COLUMNS, r, strict=True)) for r in rows], "grasps": grasps, "bytes": size}, options.json)


if __name__ == "__main__":
    main()
