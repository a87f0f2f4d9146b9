"""Which stored labels fail under `carry` and `robust`, why, what settling and a second try win back, and what each costs.

Grasps of training objects alone are drawn: of each hand, some objects, and some grasps on each. A grasp that `turned` is
told by the number of links that touch the object, as two contacts cannot hold a rotation about their line. CPU times are
of one thread.

    python -m lab.studies.label_failures [data/grasps] [--objects 4] [--grasps 8] [--rows rows.jsonl]
"""

from __future__ import annotations

import argparse
import json
import random
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import torch

from dro_grasp.compare.metrics import wilson_interval
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.stages import refine
from dro_grasp.simulation.outcome import Failure, TrialResult
from dro_grasp.simulation.trial import simulate
from dro_grasp.training.data.collections.collection import PairGrasps, Sources, read_collection
from dro_grasp.training.data.engine.labels import RESTLESS, at_rest
from lab.benchmarks.report import ROOT

HELD = "holds"
Result = TypeVar("Result")


def reason(trial: TrialResult, i: int) -> str:
    """Why a grasp fails, and for what turned, about how many links; HELD where it does not fail."""
    failure = trial.failure[i]
    if failure is None:
        return HELD
    if failure is Failure.TURNED:
        links = len(trial.contact_links[i])
        return f"turned, {links if links < 4 else '4 or more'} links"
    return failure.value


class Clock:
    """CPU seconds by what they were spent on."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.grasps: Counter[str] = Counter()

    def of(self, name: str, count: int, work: Callable[[], Result]) -> Result:
        """The result of some work on so many grasps."""
        start = time.process_time()
        result = work()
        self.seconds[name] += time.process_time() - start
        self.grasps[name] += count
        return result


def sampled(pairs: list[PairGrasps], objects: int, grasps: int) -> Iterator[tuple[PairGrasps, GraspBatch]]:
    """Of each hand some objects, of each some grasps, in random order."""
    rng, by_hand, drawn = random.Random(0), {}, []
    for pair in pairs:
        by_hand.setdefault(pair.hand, []).append(pair)
    for own in by_hand.values():
        drawn += rng.sample(own, objects)
    rng.shuffle(drawn)
    for pair in drawn:
        yield pair, pair.grasps[sorted(rng.sample(range(len(pair.grasps)), min(grasps, len(pair.grasps))))]


def tried(hand: Any, obj: Any, grasps: GraspBatch, clock: Clock) -> list[dict[str, Any]]:
    """What becomes of each grasp: as stored, settled, and refined and settled again where that failed."""
    n, problem = len(grasps), GraspProblem(hand, obj)

    def trial(name: str, batch: GraspBatch) -> TrialResult:
        simulate(hand, obj, batch[:1], name.split()[0], workers=1)  # compiles the scene, which a pair needs once
        return clock.of(name, len(batch), lambda: simulate(hand, obj, batch, name.split()[0], workers=1))

    stored = {name: trial(name, grasps) for name in ("carry", "robust")}
    rows: list[dict[str, Any]] = [{name: reason(found, i) for name, found in stored.items()} for i in range(n)]
    given = {"settled": (torch.arange(n), grasps)}
    while given:
        name, (index, batch) = given.popitem()
        closed, stable = clock.of(name, len(batch), lambda batch=batch: at_rest(hand, obj, batch))
        carried = trial(f"carry {name}", closed)
        held = carried.success.nonzero()[:, 0]
        for i, row in enumerate(index.tolist()):
            rows[row][f"{name} carry"] = reason(carried, i) if stable[i] else RESTLESS
            rows[row][f"{name} carry of the restless"] = bool(carried.success[i]) and not bool(stable[i])
        if len(held):
            robust = trial(f"robust {name}", closed[held])
            for i, k in enumerate(held.tolist()):
                rows[int(index[k])][f"{name} robust"] = reason(robust, i)
        failed = [i for i in index.tolist() if rows[i].get(f"{name} robust") != HELD]
        if name == "settled" and failed:
            refined = clock.of("refine", len(failed), lambda failed=failed: refine(problem, grasps[failed]))
            given["again"] = torch.tensor(failed), refined
    return rows


def share(rows: list[dict[str, Any]], test: Callable[[dict[str, Any]], bool]) -> str:
    """A rate with its interval."""
    k = sum(map(test, rows))
    low, high = wilson_interval(k, len(rows))
    return f"{k} of {len(rows)}, {100 * k / len(rows):.0f} % ({100 * low:.0f} to {100 * high:.0f})"


def holds(row: dict[str, Any], name: str = "settled") -> bool:
    """Whether a grasp passes both protocols once settled, or at the second try."""
    return row.get(f"{name} robust") == HELD or (name == "again" and holds(row))


def table(rows: list[dict[str, Any]], clock: Clock) -> None:
    """Print counts, reasons and costs."""
    print("as stored:", *(f"{p} {share(rows, lambda r, p=p: r[p] == HELD)};" for p in ("carry", "robust")),
          "both", share(rows, lambda r: r["carry"] == r["robust"] == HELD))
    print("settled: carry", share(rows, lambda r: r["settled carry"] == HELD), "; both", share(rows, holds))
    print("with a second try: both", share(rows, lambda r: holds(r, "again")))
    for column in ("carry", "robust", "settled carry", "settled robust", "again carry", "again robust"):
        print(column, dict(Counter(r[column] for r in rows if column in r).most_common()))
    for key in ("hand", "object"):
        for name in sorted({r[key] for r in rows}):
            own = [r for r in rows if r[key] == name]
            print(f"  {name}: {share(own, holds)}; again {share(own, lambda r: holds(r, 'again'))}")
    print("CPU [ms a grasp]:", {name: round(1e3 * s / max(1, clock.grasps[name])) for name, s in clock.seconds.items()})


def main() -> None:
    """Draw, try, print after each pair."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", default=ROOT / "data" / "grasps", help="grasps")
    parser.add_argument("--objects", type=int, default=4, help="objects of each hand")
    parser.add_argument("--grasps", type=int, default=8, help="grasps of each pair")
    parser.add_argument("--rows", type=Path, help="file of what became of each grasp, one JSON object a line")
    options = parser.parse_args()
    torch.set_num_threads(1)
    pairs = [p for p in read_collection(options.data) if len(p.grasps) and "validate" not in p.grasps.split]
    sources, clock, rows = Sources(), Clock(), []
    for pair, grasps in sampled(pairs, options.objects, options.grasps):
        hand, obj = sources.of(grasps)
        for row in tried(hand, obj, grasps, clock):
            rows.append({"hand": pair.hand, "object": pair.object} | row)
        if options.rows is not None:
            options.rows.write_text("".join(json.dumps(row) + "\n" for row in rows))
        print(f"\n{len(rows)} grasps", flush=True)
        table(rows, clock)


if __name__ == "__main__":
    main()
