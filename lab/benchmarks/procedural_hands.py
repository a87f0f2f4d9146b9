"""How many plans of procedural hands are drawn again and why, and what a data set of such hands yields, as Markdown.

Run it as `python -m lab.benchmarks.procedural_hands --num 50`, and with `--data FOLDER` for what `dro-grasp synthesize` made.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

from dro_grasp.compare.metrics import wilson_interval
from dro_grasp.training.data.engine.shards import Yield, find_shards, read_yield
from dro_grasp.training.made_hands.making import make_hand

VARIED = ("family", "fingers", "side", "thumb", "palm", "folds_back")
"""Facts whose counts are printed."""


def print_draws(num: int) -> None:
    """What the first seeds give."""
    made = [make_hand(seed) for seed in range(num)]
    for name in VARIED:
        counts = Counter(str(hand.facts()[name]) for hand in made)
        print(f"{name}: {', '.join(f'{value} {count}' for value, count in sorted(counts.items()))}")
    reasons = Counter(reason for hand in made for reason in hand.redrawn)
    low, high = wilson_interval(num, num + reasons.total())
    print(f"{num} of {num + reasons.total()} plans kept ({100 * low:.0f}-{100 * high:.0f} %)")
    for reason, count in reasons.most_common():
        print(f"- {reason}: {count}")


def print_yields(folder: Path) -> None:
    """What synthesis made of each pair of hand and object."""
    print("| hand | object | candidates | valid | share [%] | per CPU-hour |\n|---|---|---|---|---|---|")
    pairs: dict[tuple[str, str], Yield] = {}
    for shard in find_shards(folder):
        pair = Path(shard.hand).stem, Path(shard.object).stem
        pairs[pair] = pairs.get(pair, Yield()) + read_yield(folder, shard)
    pairs["all", ""] = sum(pairs.values(), Yield())
    for (hand, obj), made in pairs.items():
        print(f"| {hand} | {obj} | {made.candidates:,} | {made.valid:,} | {100 * made.valid / made.candidates:.0f} | "
              f"{made.per_cpu_hour:,.0f} |")
    print(f"\n{pairs['all', ''].cpu_seconds:.0f} CPU-seconds")


def main() -> None:
    """Print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num", type=int, default=50, help="seeds, from 0 on; 0 for none")
    parser.add_argument("--data", type=Path, help="folder that `dro-grasp synthesize` filled")
    options = parser.parse_args()
    if options.num:
        print_draws(options.num)
    if options.data is not None:
        print_yields(options.data)


if __name__ == "__main__":
    main()
