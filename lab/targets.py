"""The targets of 1.0, each beside what was measured of it: reached, not reached, or not measured.

    python -m lab.targets

docs/results.md has the same table. Rows are of the state that each names, which may differ; those of one row do not.
"""

from __future__ import annotations

import csv
import statistics
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import Any

from dro_grasp.compare.metrics import success_rate
from dro_grasp.compare.rows import Row, average
from lab.benchmarks import gpu_table
from lab.benchmarks.report import ROOT
from lab.measurements import FLAT_THINGS, PAPER_HANDS, ROBOTS, STORED
from lab.reading import (
    MissingResult,
    Results,
    as_row,
    confidence_bins,
    payload_errors,
    percent,
    plain,
    select,
    state_of,
    table,
    with_half,
)
from lab.robot_tables import HOLD_NOISES, LIFTED, attempts, hold_rows

PUBLISHED = ROOT / "lab" / "notebook" / "2026-11-published-hands.csv"
"""Twenty-four published hands, judged from pictures one by one."""
FEWEST_IN_BIN = 30
"""Grasps of a tenth of confidence below which its success is not told from chance by less than the target."""


@dataclass(frozen=True)
class Found:
    """What was measured."""

    value: float
    told: str  # with its unit, and interval and number where it is a rate


Measure = Callable[[Results], Found]


@dataclass(frozen=True)
class Target:
    """One thing to reach."""

    subject: str
    what: str
    goal: float
    measure: Measure
    least: bool = True  # whether more is better
    unit: str = "%"

    def line(self, results: Results) -> list[object]:
        """What, the goal, what was measured of which commit, and whether it is reached."""
        sign = "at least" if self.least else "at most"
        start = [self.subject, self.what, f"{sign} {self.goal:g} {self.unit}".strip()]
        own = Results(results.folder)
        try:
            found = self.measure(own)
        except MissingResult:
            return [*start, "", "", "not measured"]
        commits = state_of(f"'{self.what}'", own.used)
        reached = found.value >= self.goal if self.least else found.value <= self.goal
        return [*start, found.told, commits, "reached" if reached else "**not reached**"]


def rate(row: Row, protocol: str) -> Found:
    """Success of grasps that were asked for."""
    if protocol not in row.success:
        raise MissingResult(protocol)
    return Found(100 * row.success[protocol][0], f"{percent(row.success[protocol])} % of {row.asked}")


def counted(good: int, n: int) -> Found:
    """Success of counts."""
    if not n:
        raise MissingResult("")
    return Found(100 * good / n, f"{percent(success_rate(good, n))} % of {n}")


def alone(results: Results, where: str, protocol: str) -> Found:
    """The network's grasps as it makes them, of the paper's hands."""
    return rate(average(select(results.rows("headline", where, "stages"), "network", "raw")), protocol)


def _unseen(results: Results) -> list[Row]:
    return select(results.rows("unseen", ending="network alone"), "network", "raw")


def unseen(results: Results, protocol: str) -> Found:
    """The same of hands that no weights were trained on."""
    return rate(average(_unseen(results)), protocol)


def worst_unseen(results: Results, protocol: str) -> Found:
    """The worst of these hands."""
    rows = _unseen(results)
    if any(protocol not in row.success for row in rows):
        raise MissingResult(protocol)
    worst = min(rows, key=lambda row: row.success[protocol][0])
    found = rate(worst, protocol)
    return Found(found.value, f"{found.told}, {plain(worst.hand)}")


def optimisers_share(results: Results) -> Found:
    """How much of what is returned for unseen hands the optimiser made."""
    rows = select(results.rows("unseen", ending="returned"), "auto", "returned")
    shares = [100 * row.optimised for row in rows]
    every = 100 * average(rows).optimised
    return Found(every, f"{every:.0f} %, by hand {min(shares):.0f} to {max(shares):.0f} %")


def diversity(results: Results, hand: str) -> Found:
    """The paper's measure, over what is returned on the paper's objects."""
    (row,) = (row for row in results.rows("headline", "validate", "returned") if row.hand == hand)
    return Found(round(row.diversity, 3), f"{row.diversity:.3f}, {row.returned} grasps")


def paper_form(results: Results) -> Found:
    """The paper's own form, slim, under its own protocol."""
    (found,) = results.cell("fidelity", "trained")["pretrained"]
    return rate(average(select(list(map(as_row, found["rows"])), "network", "raw")), "dro")


def _returned(results: Results, where: str) -> list[Row]:
    return results.rows("headline", where, "returned")


def held(results: Results, rows: Callable[[Results], list[Row]], protocol: str) -> Found:
    """What holds, of what was asked of some hands."""
    return rate(average(rows(results)), protocol)


def worst_published(results: Results) -> Found:
    """The published hand, and the protocol, under which least of what was asked for holds."""
    found = [(row.success[protocol][0], protocol, name, row) for name, cell in results.cells("published_hard").items()
             for row in [as_row(cell["rows"][0])] for protocol in ("strict", "dexgraspbench", "robust", "carry")]
    _, protocol, name, row = min(found, key=lambda each: each[0])
    own = rate(row, protocol)
    return Found(own.value, f"{own.told}, {name}, `{protocol}`")


def flat_grasps(results: Results, asked: bool) -> Found:
    """Grasps of flat and thin things that carry."""
    rows = [row for cell in results.cells("flat").values() for row in cell["rows"]]
    return counted(sum(row["held"] or 0 for row in rows), sum(row["asked" if asked else "returned"] or 0 for row in rows))


def fingers(results: Results, every: bool) -> Found:
    """Fingers that touch under `strict`, or grasps of which all do, of the network's best on the paper's objects."""
    row = average(select(results.rows("headline", "validate", "stages"), "network", "settled, ranked"))
    value = 100 * row.fingers["strict"][int(every)]
    return Found(value, f"{value:.0f} %, {row.returned} grasps")


def worst_tenth(results: Results) -> Found:
    """Where confidence is farthest from what held, where there are enough grasps to tell."""
    bins = [b for b in confidence_bins(results) if b.n >= FEWEST_IN_BIN]
    worst = max(bins, key=lambda b: abs(b.predicted - b.held / b.n))
    value = 100 * abs(worst.predicted - worst.held / worst.n)
    return Found(value, f"{value:.0f} points, {worst.n} grasps of {10 * worst.tenth} to {10 * worst.tenth + 10} %")


def payload_error(results: Results) -> Found:
    """Of the payload that is stated, beside trials."""
    error, _, n, _ = payload_errors(results)
    return Found(error, f"{error:.0f} %, {n} grasps")


def lost_by_half(results: Results) -> Found:
    """The most that half of the candidates loses on one group of objects [points]."""
    found = []
    for where in ("validate", "test", "hard"):
        own = [row.success["carry"][0] for row in with_half(results, where)]
        found.append((100 * (own[0] - own[1]), where, own))
    lost, where, (every, half) = max(found)
    return Found(lost, f"{lost:.1f} points: {100 * half:.1f} instead of {100 * every:.1f} %, {where}")


def seconds(results: Results, name: str) -> Found:
    """A whole command."""
    value = results.cell("speed", "commands")[name]
    return Found(value, f"{value:.2g}")


def latency(results: Results, name: str) -> Found:
    """A returned grasp of as many as the name says, on two cores [ms]."""
    value = 1e3 * results.cell("speed", "returned")["seconds_a_grasp"][name]
    return Found(value, f"{value:.0f}")


def tried(results: Results, robot: str, measurement: str) -> Found:
    """Attempts of a robot that succeed; of those with a place, of what was lifted."""
    own = attempts(results, measurement, robot)
    counts = [a for a in own if a["stage"] in LIFTED] if measurement == "placed" else own
    return counted(sum(a["success"] for a in counts), len(counts))


def _tables(results: Results) -> list[dict[str, Any]]:
    """Tables that the robots cleared; MissingResult: of one of them there is none."""
    done = [results.some("cleared", robot) for robot in ROBOTS]
    if not all(done):
        raise MissingResult("cleared")
    return list(chain(*done))


def cleared(results: Results) -> Found:
    """Things that both robots take from their tables."""
    done = _tables(results)
    return counted(sum(cell["removed"] for cell in done), sum(cell["things"] for cell in done))


def picks(results: Results) -> Found:
    """Picks for each of these."""
    done = _tables(results)
    if not (removed := sum(cell["removed"] for cell in done)):
        raise MissingResult("cleared")
    value = sum(cell["picks"] for cell in done) / removed
    return Found(value, f"{value:.2f} for {removed} things")


def holding(results: Results) -> Found:
    """Judgements by the joints, with the noise that hands have, that are right."""
    rows = hold_rows(results, HOLD_NOISES[0])
    return counted(sum(row[row["truth"]] for row in rows), sum(row["n"] for row in rows))


def planning(results: Results, column: str, choose: Callable[[list[float]], float]) -> Found:
    """Time from the image of a scene to a plan, of both robots [s]."""
    rows = [results.cell("planning", robot)["rows"][0] for robot in ROBOTS]
    value = choose([row[column] for row in rows])
    return Found(value, f"{value:.1f}, {sum(row['asked'] for row in rows)} scenes")


def flat(results: Results) -> Found:
    """Flat and thin things that both robots lift."""
    own = [a for robot in ROBOTS for name in FLAT_THINGS for cell in results.some("flat_lifts", f"{robot}, {name}")
           for a in cell["attempts"]]
    return counted(sum(a["success"] for a in own), len(own))


def published(_: Results, columns: tuple[str, ...]) -> Found:
    """Published hands that are right in all these columns of the notebook, in their last state."""
    with PUBLISHED.open() as file:
        last = {line["hand"]: line for line in csv.DictReader(file)}
    good = sum(all(line[column] == "yes" for column in columns) for line in last.values())
    return Found(good, f"{good} of {len(last)}")


def on_gpu(results: Results, row: gpu_table.Row) -> Found:
    """A row of the table of GPUs."""
    cell = results.cell("gpu", "table")
    if row.name not in cell["rows"]:
        raise MissingResult("gpu")
    value = row.value(cell["rows"][row.name])
    return Found(value, f"{value:,.4g}")


def agreeing(results: Results, hand: str) -> Found:
    """Stored grasps whose trial ends as on MuJoCo."""
    row, = results.cell("agreement", hand)["rows"]
    return counted(row["same"], row["grasps"])


RIGHT = ("accepted", "fingers", "thumb", "side", "palm", "open")
"""What of a published hand is judged from pictures."""


def targets() -> Iterator[Target]:
    """All of them, by subject."""
    yield Target("hands", "published hands accepted as they are, of 24", 23, partial(published, columns=("accepted",)), unit="")
    yield Target("hands", "right by pictures, of these", 22, partial(published, columns=RIGHT), unit="")
    for path in STORED:
        yield Target(
            "Warp on the processor", f"verdicts of MuJoCo, `strict`, {path.stem}", 97, partial(agreeing, hand=path.stem))
    for row in gpu_table.ROWS:
        yield Target("GPU", row.what, row.goal, partial(on_gpu, row=row), not row.fewer, row.unit)
    yield Target("two cores", "one of sixteen grasps with its candidates", 80,
                 partial(latency, name="16"), False, "ms")
    yield Target("two cores", "one grasp alone", 250, partial(latency, name="1"), False, "ms")
    yield Target("two cores", "`generate --num 1`", 3.5, partial(seconds, name="1 grasp"), False, "s")
    yield Target("two cores", "`generate --num 16`", 4, partial(seconds, name="16 grasps"), False, "s")
    for measurement, what, goal in (("lifts", "lifted, held and shaken", 95), ("asked", "the same, asked for among others", 95),
                                    ("placed", "placed, of those lifted", 90)):
        for robot in ROBOTS:
            yield Target("robots", f"{what}, `{robot}`", goal, partial(tried, robot=robot, measurement=measurement))
    yield Target("robots", "things cleared, six on a table", 95, cleared)
    yield Target("robots", "picks for each", 1.3, picks, False, "")
    yield Target("robots", "holding, empty or slipping told", 98, holding)
    median = partial(planning, column="image to plan [s], median", choose=statistics.fmean)
    yield Target("robots", "scene image to plan, mean of the robots' medians", 5, median, False, "s")
    yield Target("robots", "the same, longest", 12, partial(planning, column="longest", choose=max), False, "s")
    yield Target("robots", "flat and thin things lifted", 60, flat)
    for where, goals in (("validate", (97, 88, 75)), ("test", (92, 75, 60))):
        for protocol, goal in zip(("dro", "strict", "dexgraspbench"), goals, strict=True):
            yield Target("network alone", f"paper's hands, {'paper' if where == 'validate' else 'built-in test'} objects, "
                         f"`{protocol}`", goal, partial(alone, where=where, protocol=protocol))
    for protocol, every, each in (("dro", 88, 75), ("strict", 72, 45)):
        yield Target("network alone", f"unseen hands, `{protocol}`", every, partial(unseen, protocol=protocol))
        yield Target("network alone", f"the worst of them, `{protocol}`", each, partial(worst_unseen, protocol=protocol))
    yield Target("network alone", "paper's form, `dro`", 90, paper_form)
    yield from _carried()
    yield Target("returned", "made by the optimiser, unseen hands", 20, optimisers_share, False)
    for hand, goal in zip(PAPER_HANDS, (0.53, 0.40, 0.40), strict=True):
        yield Target("returned", f"diversity, {plain(hand)}", goal, partial(diversity, hand=hand), unit="")
    yield Target("returned", "lost under `carry` with half of the candidates", 1, lost_by_half, False, "points")


def _carried() -> Iterator[Target]:
    """What `generate` returns, of what was asked for, and what it says of it."""
    usual = {"dexgraspbench": 99, "robust": 99, "carry": 97}
    for label, rows, goals in (
            ("paper's hands, paper objects", partial(_returned, where="validate"), usual),
            ("paper's hands, built-in test objects", partial(_returned, where="test"), usual),
            ("paper's hands, hard objects", partial(Results.rows, measurement="hard"),
             {"strict": 98, "dexgraspbench": 92, "robust": 90, "carry": 90}),
            ("published hands, built-in test objects", partial(Results.rows, measurement="published"),
             {"strict": 98, "dexgraspbench": 95, "robust": 92, "carry": 92}),
            ("published hands, hard objects", partial(Results.rows, measurement="published_hard"),
             {"strict": 95, "dexgraspbench": 85, "robust": 80, "carry": 80})):
        for protocol, goal in goals.items():
            yield Target("returned", f"{label}, `{protocol}`", goal, partial(held, rows=rows, protocol=protocol))
    yield Target("returned", "the worst published hand on hard objects, of these", 60, worst_published)
    for asked, goal in ((False, 85), (True, 50)):
        yield Target("returned", f"flat and thin on a table, of what was {'asked for' if asked else 'returned'}", goal,
                     partial(flat_grasps, asked=asked))
    for every, what, goal in ((False, "fingers in contact, best quarter", 93), (True, "grasps with all of them", 74)):
        yield Target("returned", what, goal, partial(fingers, every=every))
    yield Target("returned", "confidence off by, in the worst tenth with 30 grasps", 8, worst_tenth, False, "points")
    yield Target("returned", "payload, median error", 15, payload_error, False)


def all_targets(results: Results) -> str:
    """The table."""
    lines = [target.line(results) for target in targets()]
    return table(["", "target", "to reach", "measured", "commit", ""], lines)


def told(results: Results) -> str:
    """How many are reached, are not, and are not measured."""
    ends = [str(target.line(results)[-1]).strip("*") for target in targets()]
    return ", ".join(f"{ends.count(end)} {end}" for end in ("reached", "not reached", "not measured")) + f", of {len(ends)}"


if __name__ == "__main__":
    print(all_targets(Results()))
    print(told(Results()))
