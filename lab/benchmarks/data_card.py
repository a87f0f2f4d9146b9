"""The counts of docs/data-card.md, from the files themselves.

Run it as `python -m lab.benchmarks.data_card [data/grasps] [--pictures docs/pictures] [--json]`.

With `--labels data/labels` it tells instead what `dro-grasp dataset filter` keeps of these grasps in that folder, which
`make labels` fills, and what diversity that costs. Half of a run is a fair sample of the whole: counts and diversity are of
the pairs that are done, before and after.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

from dro_grasp.compare.rows import finger_contact
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.training.data.collections.collection import count_collection, read_collection
from dro_grasp.training.data.collections.coverage import HandCoverage, measure_coverage
from dro_grasp.training.data.collections.filtering import read_kept
from dro_grasp.training.data.collections.report import charts, grasps_drawn
from dro_grasp.training.data.engine.shards import Yield, find_shards
from lab.benchmarks.report import ROOT, emit, options_of, rate

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


KEPT = ("hand", "pairs", "grasps", "kept", "kept [%]", "made anew", "fewest", "diversity", "of kept", "wrist", "of kept wrist",
        "joints", "of kept joints", "all six half-axes [%]", "of kept half-axes [%]")
"""Headings of the table of what a filter keeps."""


def kept_rows(folder: Path, labels: Path) -> tuple[list[list[str]], Counter[str]]:
    """What a filter has kept so far of each hand's grasps, and why the others are left out."""
    done = {(shard.hand, shard.object): shard for shard in find_shards(labels)}
    rows, reasons, total = [], Counter[str](), Counter[str]()
    for path in sorted(folder.glob("*.parquet")):
        before = [pair for pair in read_collection(path, only_successful=False) if (pair.hand, pair.object) in done]
        if not before:
            continue
        shards = [done[pair.hand, pair.object] for pair in before]
        told = [read_kept(labels, shard) for shard in shards]
        after = [replace(pair, grasps=GraspBatch.load(shard.path(labels))) for pair, shard in zip(before, shards, strict=True)]
        counts = Counter(pairs=len(told), grasps=sum(k.grasps for k in told), kept=sum(k.kept for k in told),
                         remade=sum(k.remade for k in told))
        reasons, total = sum((Counter(k.failures) for k in told), reasons), total + counts
        measures = [_measured(*measure_coverage(pairs)) for pairs in (before, after)]
        rows.append([told[0].hand, *_counted(counts), str(min(k.kept for k in told)),
                     *(cell for both in zip(*measures, strict=True) for cell in both)])
    return [*rows, ["all", *_counted(total), *[""] * (len(KEPT) - 6)]], reasons


def _counted(counts: Counter[str]) -> list[str]:
    share = rate([True] * counts["kept"], counts["grasps"])
    return [str(counts["pairs"]), f"{counts['grasps']:,}", f"{counts['kept']:,}", share, f"{counts['remade']:,}"]


def _measured(hand: HandCoverage) -> list[str]:
    """Diversity, of wrist and joints, and the share of objects that are grasped from all six half-axes."""
    everywhere = sum(min(pair.half_axes) > 0 for pair in hand.pairs) / len(hand.pairs)
    return [*(f"{value:.3f}" for value in hand.diversity.values()), f"{100 * everywhere:.0f}"]


def main() -> None:
    """Print."""
    parser = options_of(__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=ROOT / "data" / "grasps", help="merged files")
    parser.add_argument("--labels", type=Path, help="tell what a filter keeps of them in this folder")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of one hand")
    options = parser.parse_args()
    folder = options.folder
    if options.pictures is not None:
        (hand,) = measure_coverage(read_collection(folder / PICTURED))
        (options.pictures / "data-charts.png").write_bytes(charts(hand))
        (options.pictures / "data-grasps.png").write_bytes(grasps_drawn(hand))
    if options.labels is not None:
        rows, reasons = kept_rows(folder, options.labels)
        emit(f"kept of {folder}", rows, KEPT, {
            "rows": [dict(zip(KEPT, r, strict=True)) for r in rows], "reasons": dict(reasons.most_common()),
            "pairs": sum(map(len, count_collection(folder).values()))}, options.json)
        return
    files = sorted(folder.glob("*.parquet"))
    grasps, size = sum(len(p.grasps) for p in read_collection(folder)), sum(path.stat().st_size for path in files)
    emit(f"{grasps:,} grasps, {size / 1e6:.1f} MB", rows := [row(path) for path in files], COLUMNS,
         {"rows": [dict(zip(COLUMNS, r, strict=True)) for r in rows], "grasps": grasps, "bytes": size}, options.json)


if __name__ == "__main__":
    main()
