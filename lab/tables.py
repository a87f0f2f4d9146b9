"""Tables, numbers and figures of README and docs, from the data in lab/results.

    python -m lab.tables [--check]

A table is of one state: its rows come from the same code and the same weights. What was not measured says so.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import hashlib
import json
import math
import statistics
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from dro_grasp.arm.motion import PLACING
from dro_grasp.compare.metrics import success_rate
from dro_grasp.compare.rows import ALL, Row, average
from lab import pages
from lab.benchmarks.report import ROOT
from lab.measurements import FLAT_THINGS, MEASUREMENTS, PAPER_HANDS, ROBOTS, SEEN_IN_PART, TEST_OBJECTS
from lab.runner import RESULTS
from lab.studies import payload

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
"""Pages that have markers."""
FIGURE = ROOT / "docs" / "pictures" / "results.png"
"""Success by method and protocol."""
PAPER = {"DFC": (86.3, 76.2, 58.8), "GenDexGrasp": (67.0, 51.0, 54.2), "ManiFM-style": (None, 42.6, None),
         "D(R,O)": (87.3, 92.3, 83.0)}
"""Success on Barrett, Allegro and Shadow hand [%]. Source: paper, table of the overall comparison, in Isaac Gym."""
STAGES = {"raw": "network alone", "refined": "refined", "settled": "refined, settled",
          "settled, ranked": "the best quarter of these by score"}
"""Stages of the network's grasps, and what they are called."""
METHODS = {"auto": "dro-grasp", "optimiser": "optimiser alone", "mean-grasp": "mean grasp of the training set",
           "start": "unoptimised starts"}
"""Methods of equal time, and what they are called."""
CONTROLS = {name: f"{text}, equal time" for name, text in METHODS.items() if name != "auto"}
"""Those that no network takes part in."""
TASKS = {"lifts": "lifted, held and shaken", "asked": "the same, of the one asked for among three others",
         "placed": "placed within 2 cm and 15 degrees, of those lifted"}
"""Measurements of attempts, and what they are called."""
LIFTED = {*PLACING, "place", "done"}
"""Where attempts with a place end whose object was in the air."""
HELD_BY = "watched"
"""What is measured of hands that may hold, in `lab.benchmarks.hold_check`."""
Cell = dict[str, Any]


class MissingResult(Exception):
    """A table needs what was not measured."""


class Results:
    """Results of measurements, and which of them a table has looked at."""

    def __init__(self, folder: Path = RESULTS) -> None:
        self.folder, self.used = folder, {}

    def cell(self, measurement: str, name: str) -> Any:
        """What a command printed.

        Raises:
            MissingResult: It was not run as it is declared now.
        """
        path = self.folder / f"{measurement}.json"
        cells = _cells(path) if path.exists() else {}
        if cells.get(name, {}).get("command") != MEASUREMENTS[measurement].cells[name]:
            raise MissingResult(measurement)
        self.used[f"{measurement}: {name}"] = cells[name]
        return cells[name]["result"]

    def cells(self, measurement: str, ending: str = "") -> dict[str, Any]:
        """What all commands of a measurement printed whose names end so."""
        return {name: self.cell(measurement, name) for name in MEASUREMENTS[measurement].cells if name.endswith(ending)}

    def some(self, measurement: str, start: str = "") -> list[Any]:
        """What those commands printed whose names start so, of those that were run."""
        found = list[Any]()
        for name in MEASUREMENTS[measurement].cells:
            if name.startswith(start):
                with contextlib.suppress(MissingResult):
                    found.append(self.cell(measurement, name))
        return found

    def rows(self, measurement: str, start: str = "", ending: str = "") -> list[Row]:
        """Rows of `dro-grasp benchmark` of all commands whose names start and end so."""
        found = [n for n in MEASUREMENTS[measurement].cells if n.startswith(start) and n.endswith(ending)]
        return [as_row(line) for name in found for line in self.cell(measurement, name)["rows"]]


@functools.cache
def _cells(path: Path) -> dict[str, Cell]:
    return json.loads(path.read_text())["cells"]


def as_row(line: dict[str, Any]) -> Row:
    """A row as it was before it was printed."""
    return Row(**{field.name: _numbers(line[field.name]) for field in dataclasses.fields(Row)})


def _numbers(value: Any) -> Any:
    """Nothing becomes NaN again, and the label of a protocol its name."""
    if isinstance(value, dict):
        return {key.partition("/")[0]: _numbers(v) for key, v in value.items()}
    if isinstance(value, list):
        return tuple(_numbers(v) for v in value)
    return math.nan if value is None else value


def mixed(used: dict[str, Cell]) -> list[str]:
    """In what the results of one table differ that should be of one state."""
    found = ["weights"] if len({json.dumps(cell["weights"], sort_keys=True) for cell in used.values()}) > 1 else []
    states: dict[str, set[str]] = {}
    for cell in used.values():
        for name, digest in cell["code"].items():  # measurements rest on different parts
            states.setdefault(name, set()).add(digest)
    return found + [f"code of {name}" for name, digests in states.items() if len(digests) > 1]


def percent(rate: Sequence[float]) -> str:
    """Success and its interval [%]."""
    return "-" if math.isnan(rate[0]) else f"{100 * rate[0]:.1f} [{100 * rate[1]:.0f}-{100 * rate[2]:.0f}]"


def of(held: int, asked: int) -> str:
    """Success of counts and its interval [%]."""
    return percent(success_rate(held, asked))


def table(columns: Sequence[str], lines: Sequence[Sequence[object]]) -> str:
    """Markdown; a column that is empty everywhere is left out."""
    filled = [i for i, _ in enumerate(columns) if i == 0 or any(str(line[i]) for line in lines)]
    columns, lines = [columns[i] for i in filled], [[line[i] for i in filled] for line in lines]
    return "\n".join(f"|{'|'.join(map(str, line))}|" for line in (columns, ["---"] * len(columns), *lines))


PROTOCOLS = ("carry", "robust", "dexgraspbench", "strict", "dro")
"""Columns, the one that asks most of a grasp first; those that a measurement does without are left out."""
DRAWN = ("carry", "dexgraspbench", "strict")
"""Protocols in the figure: those of all of its methods."""


def line(label: str, row: Row, *more: object) -> list[object]:
    """A row's cells: asked, returned, success, fingers that touch under `strict`, and what else is given."""
    share, everyone = row.fingers["strict"]
    rates = [percent(row.success[p]) if p in row.success else "" for p in PROTOCOLS]
    return [label, f"{row.asked}/{row.returned}", *rates, f"{100 * share:.0f} ({100 * everyone:.0f})", *more]


HEAD = ["", "asked/returned", *(f"`{p}` [%]" for p in PROTOCOLS), "fingers (all) [%]"]


def plain(hand: str) -> str:
    """A hand's name without the folder of the assets."""
    return hand.removeprefix("assets/")


def select(rows: Sequence[Row], grasps: str, stage: str) -> list[Row]:
    """Rows of single hands."""
    return [row for row in rows if row.grasps == grasps and row.stage == stage and row.hand != ALL]


def headline_short(results: Results) -> str:
    """The README's table."""
    returned = {where: average(results.rows("headline", where, "returned")) for where in ("validate", "test")}
    stages, controls = results.rows("headline", "validate", "stages"), results.rows("headline", "validate", "controls")
    lines = [
        line("returned by `generate`, the paper's objects", returned["validate"]),
        line("returned by `generate`, built-in test objects", returned["test"]),
        line("returned by `generate`, hard objects", average(results.rows("hard"))),
        line("twelve published hands, hard objects", average(results.rows("published_hard"))),
        line("network alone, nothing refined", average(select(stages, "network", "raw"))),
        *(line(text, average(select(controls, name, "equal-time"))) for name, text in CONTROLS.items()),
    ]
    lenient = HEAD.index("`dro` [%]")
    return table([*HEAD[:lenient], *HEAD[lenient + 1:]], [[*cells[:lenient], *cells[lenient + 1:]] for cells in lines])


def headline_stages(results: Results, where: str) -> str:
    """What each step adds, and what is returned of each hand."""
    returned, stages = results.rows("headline", where, "returned"), results.rows("headline", where, "stages")
    lines = [line(text, average(select(stages, "network", stage))) for stage, text in STAGES.items()]
    lines += [line(f"returned, {plain(row.hand)}", row) for row in returned]
    return table(HEAD, [*lines, line("**returned by `generate`**", average(returned))])


def headline_controls(results: Results, where: str) -> str:
    """Methods that have the same processor time for a returned grasp."""
    rows = results.rows("headline", where, "controls")
    found = {name: average(select(rows, name, "equal-time")) for name in METHODS}
    return table([*HEAD, "diversity", "candidates", "CPU ms a grasp"], [
        line(METHODS[name], row, f"{row.diversity:.3f}", f"{row.candidates:.0f}", f"{1e3 * row.seconds['CPU']:.0f}")
        for name, row in found.items()])


def diversity(results: Results) -> str:
    """The paper's measure of what is returned, by hand."""
    rows = results.rows("headline", "validate", "returned")
    alone = select(results.rows("headline", "validate", "stages"), "network", "raw")
    return table(["hand", "returned", "network alone"],
                 [[plain(a.hand), f"{a.diversity:.3f}", f"{b.diversity:.3f}"] for a, b in zip(rows, alone, strict=True)])


def unseen(results: Results) -> str:
    """Hands that no weights were trained on, by source."""
    rows = [*results.rows("unseen", ending="returned"), *results.rows("unseen", ending="sources")]
    lines = []
    for name, text in (("auto", "returned by `generate`"), ("network", "by the network alone, finished"),
                       ("optimiser", "by the optimiser alone, finished")):
        own = select(rows, name, "returned")
        if name == "auto":
            lines += [line(f"returned, {plain(row.hand)}", row, f"{100 * row.optimised:.0f}") for row in own]
        lines.append(line(f"**{text}**", average(own), f"{100 * average(own).optimised:.0f}"))
    alone = average(select(results.rows("unseen", ending="network alone"), "network", "raw"))
    return table([*HEAD, "optimiser's [%]"], [*lines, line("network alone, nothing refined", alone, 0)])


def hands(results: Results, measurement: str) -> str:
    """What is returned for each hand of a measurement, and for all."""
    found = {name: as_row(cell["rows"][0]) for name, cell in results.cells(measurement).items()}
    lines = [line(name, row, f"{100 * row.optimised:.0f}") for name, row in found.items()]
    every = average(list(found.values()))
    return table([*HEAD, "optimiser's [%]"], [*lines, line("**all**", every, f"{100 * every.optimised:.0f}")])


def views(results: Results) -> str:
    """What is seen of the object, and what holds."""
    text = {"cloud": "points of the whole surface", "half": "half of the points, as in the paper", "depth": "one depth image"}
    return table(HEAD, [line(text[view], average(results.rows("views", view))) for view in text])


def robot_tasks(results: Results) -> str:
    """What robots do on their tables, and how often they succeed; what was not measured says so."""
    lines = []
    for measurement, text in TASKS.items():
        for robot in ROBOTS:
            tried = attempts(results, measurement, robot)
            counted = [a for a in tried if a["stage"] in LIFTED] if measurement == "placed" else tried
            ended = ", ".join(f"{stage} {count}" for stage, count in Counter(a["stage"] for a in tried).items())
            good = sum(a["success"] for a in counted)
            lines.append(counts(f"{text}, `{robot}`", measurement, len(tried), good, len(counted), ended))
    for robot in ROBOTS:
        done = results.some("cleared", robot)
        removed, things, picks = (sum(cell[key] for cell in done) for key in ("removed", "things", "picks"))
        also = f"{picks / removed:.2f} picks each, {sum(cell['tables'] for cell in done)} tables" if removed else ""
        lines.append(counts(f"things cleared, six on a table, `{robot}`", "cleared", things, removed, things, also))
    for robot in ROBOTS:
        tried = [a for name in FLAT_THINGS for cell in results.some("flat_lifts", f"{robot}, {name}") for a in cell["attempts"]]
        ended = ", ".join(f"{stage} {count}" for stage, count in Counter(a["stage"] for a in tried).items())
        good = sum(a["success"] for a in tried)
        lines.append(counts(f"flat and thin things lifted, held and shaken, `{robot}`", "flat_lifts", len(tried), good,
                            len(tried), ended))
    right, n = Counter[str](), Counter[str]()
    for row in (row for cell in results.some("holding") for row in cell["rows"]):
        if row["hand"] != "all" and row["measured"] == HELD_BY:
            right[row["truth"]] += row[row["truth"]]
            n[row["truth"]] += row["n"]
    also = ", ".join(f"{truth} {right[truth]} of {n[truth]}" for truth in n)
    lines.append(counts("held, empty or slipping, by the joints", "holding", n.total(), right.total(), n.total(), also))
    return table(["", "asked", "counted", "reached [%]", "ended in"], lines)


def attempts(results: Results, measurement: str, robot: str) -> list[dict[str, Any]]:
    """Those of a robot, of all objects that were measured; controls are apart."""
    return [a for object_name in TEST_OBJECTS for cell in results.some(measurement, f"{robot}, {object_name}")
            for a in cell["attempts"]]


def counts(text: str, measurement: str, asked: int, good: int, counted: int, also: str) -> list[object]:
    """A line of a table of robots."""
    if not asked:
        return [text, "-", "-", f"not measured (`make results NAMES={measurement}`)", ""]
    return [text, asked, counted, of(good, counted) if counted else "-", also]


def planning(results: Results) -> str:
    """How long robots plan, from the image of a scene."""
    lines = []
    for robot in ROBOTS:
        (row,) = results.cell("planning", robot)["rows"]
        lines.append([f"`{robot}`", row["asked"], row["planned"], row["image to plan [s], median"], row["longest"],
                      row["median [s]"]])
    return table(["", "scenes", "planned", "median [s]", "longest [s]", "of one core, median [s]"], lines)


def any_grasp(results: Results) -> str:
    """The control that takes any grasp that the arm reaches."""
    lines = []
    for robot in ROBOTS:
        tried = results.cell("lifts", f"{robot}, any grasp")["attempts"]
        lines.append([f"`{robot}`", len(tried), of(sum(a["success"] for a in tried), len(tried))])
    return table(["", "attempts", "held [%]"], lines)


def constraints(results: Results) -> str:
    """What each constraint costs."""
    rows = [cell["rows"][0] for cell in results.cells("constraints").values()]
    return table(["constraint", "asked", "returned", "candidates dropped [%]", "median [s]", "longest [s]"], [
        [f"`{r['constraint']}`" if r["constraint"] != "nothing" else "none", r["asked"], r["returned"],
         f"{r['candidates dropped [%]']:.0f}", f"{r['processor time [s], median']:.1f}", f"{r['longest']:.1f}"] for r in rows])


def sides(results: Results) -> str:
    """Objects on a table, from above and from the side."""
    found: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for cell in results.cells("tables").values():
        for r in cell["rows"]:
            found.setdefault((r["hand"], r["side"]), []).append(r)
    lines = []
    for (hand, side), own in found.items():
        asked, held = sum(r["asked"] for r in own), sum(r["held"] for r in own)
        lowest = [r["clearance"] for r in own if r["clearance"] is not None]  # none where nothing was returned
        lines.append([f"{hand}, {side}", asked, sum(r["returned"] for r in own), of(held, asked),
                      f"{1e3 * min(lowest):.1f}" if lowest else "-", f"{sorted(r['cpu'] for r in own)[len(own) // 2]:.1f}"])
    return table(["", "asked", "returned", "`carry` [%]", "least clearance [mm]", "median CPU [s]"], lines)


def flat(results: Results) -> str:
    """What is flat or thin, on a table, by hand."""
    names = list(dict.fromkeys(r["object"] for cell in results.cells("flat").values() for r in cell["rows"]))
    lines = []
    for hand, cell in results.cells("flat").items():
        rows = {r["object"]: r for r in cell["rows"]}
        asked, returned, held = (sum(r[key] or 0 for r in rows.values()) for key in ("asked", "returned", "held"))
        lines.append([hand, *(f"{rows[name]['held']}/{rows[name]['returned']}" for name in names), of(held, asked),
                      of(held, returned), f"{sorted(r['cpu'] for r in rows.values())[len(rows) // 2]:.0f}"])
    columns = ["", *(name.replace("_", " ") for name in names), "of asked [%]", "of returned [%]", "median CPU [s]"]
    return table(columns, lines)


def confidence(results: Results) -> str:
    """Predicted beside observed, in ten bins: of hands that no weights were trained on, and of objects seen in part."""
    cells = results.cells("confidence")
    unseen = [cell for name, cell in cells.items() if not name.startswith(tuple(map(plain, PAPER_HANDS)))]
    in_part = [cell for name, cell in cells.items() if name.endswith(SEEN_IN_PART)]
    lines = []
    for k in range(10):
        both = [_reliability(group, k) for group in (unseen, in_part)]
        if any(map(any, both)):
            lines.append([f"{10 * k} to {10 * k + 10}", *both[0], *both[1]])
    of_part = ("seen in part", "predicted [%]", "held [%]")
    return table(["confidence [%]", "grasps", "predicted [%]", "held [%]", *of_part], lines)


def _reliability(cells: Sequence[Any], k: int) -> tuple[Any, str, str]:
    """Grasps of a bin, what was predicted of them, and how many held; empty words for none."""
    own = [b for cell in cells for b in cell["bins"] if round(10 * b["from"]) == k]
    if not (n := sum(b["n"] for b in own)):
        return "", "", ""
    predicted, held = (sum(b[key] * b["n"] for b in own) for key in ("predicted", "observed"))
    return n, f"{100 * predicted / n:.0f}", of(round(held), n)


def methods(results: Results) -> str:
    """Methods of others beside ours, and what the paper says of them."""
    lines = []
    for name in ("DFC", "GenDexGrasp", "ManiFM-style"):
        rows = results.rows("methods", name)
        made, finished = (average([row for row in rows if row.stage == stage]) for stage in ("raw", "returned"))
        lines += [line(f"{name}, as it makes them", made, "", paper(name)),
                  line(f"{name}, finished", finished, f"{finished.seconds['make']:.2f}")]
    stages, rows = results.rows("headline", "validate", "stages"), results.rows("headline", "validate", "returned")
    lines += [line("dro-grasp's network, as it makes them", average(select(stages, "network", "raw")), "", paper("D(R,O)")),
              line("dro-grasp", average(rows), f"{average(rows).seconds['make']:.2f}")]
    return table([*HEAD, "s a grasp", "the paper's, Barrett / Allegro / Shadow [%]"], [
        row if len(row) == len(HEAD) + 2 else [*row, ""] for row in lines])


def paper(name: str) -> str:
    """What the paper reports."""
    return " / ".join("-" if value is None else f"{value:.1f}" for value in PAPER[name])


def fidelity(results: Results) -> str:
    """The paper's own form, trained as long as it fits."""
    (found,) = results.cell("fidelity", "trained")["pretrained"]
    rows = {stage: average(select(list(map(as_row, found["rows"])), "network", stage)) for stage in ("raw", "refined")}
    return table(HEAD, [line(f"paper's form, slim, {text}", rows[stage])
                        for stage, text in (("raw", "network alone"), ("refined", "refined"))])


def simulation(results: Results) -> str:
    """How many outcomes stay the same with finer time steps and other settings of the solver."""
    rows = results.cell("fidelity", "simulation")["rows"]
    return table(["protocol", "setting", "trials", "held [%]", "same outcome [%]", "beyond chance (kappa)"], [
        [f"`{row['protocol']}`", row["setting"], row["trials"], of(row["held"], row["trials"]), of(row["same"], row["trials"]),
         f"{row['kappa']:.2f}"] for row in rows])


def data_card(results: Results) -> str:
    """Counts of the shipped grasps."""
    columns = ("hand", "grasps", "train", "few_shot", "validate", "objects", "fewest", "diversity", "fingers [%]",
               "all fingers [%]", "kB")
    cell = results.cell("data", "card")
    return table(columns, [[row[c] for c in columns] for row in cell["rows"]])


def labels(results: Results) -> str:
    """What the filter keeps of the shipped grasps, and of their diversity."""
    columns = {"hand": "hand", "grasps": "grasps", "kept": "kept", "kept [%]": "kept [%]", "made anew": "made anew",
               "diversity": "diversity", "of kept": "of kept", "wrist": "wrist", "of kept wrist": "of kept", "joints": "joints",
               "of kept joints": "of kept", "all six half-axes [%]": "six sides [%]", "of kept half-axes [%]": "of kept"}
    cell = results.cell("labels", "kept")
    return table(tuple(columns.values()), [[row[c] for c in columns] for row in cell["rows"]])


def labels_told(results: Results) -> str:
    """How much of the data the filter has been through."""
    cell = results.cell("labels", "kept")
    return f"{cell['rows'][-1]['pairs']} of {cell['pairs']}"


def commands(results: Results) -> str:
    """Whole commands, from shell to file."""
    told = {k: v for k, v in results.cell("speed", "commands").items() if isinstance(v, float)}
    return table(["command", "median [s]"], [[name, f"{seconds:.2g}"] for name, seconds in told.items()])


def parts(results: Results) -> str:
    """Parts beside what they replace, and rates of work."""
    cell = {name: results.cell("speed", name) for name in ("inference", "joint_solver", "kernel", "trials", "synthesis")}
    alone, many = cell["inference"]["latency_default"], cell["inference"]["batch16_per_grasp_default"]
    return table(["part", "measured"], [
        ["one grasp of one candidate, network to score [ms]", f"{1e3 * alone:.0f}"],
        ["one of sixteen such grasps [ms]", f"{1e3 * many:.0f}"],
        ["joint solver against CVXPY and Clarabel, one thread", f"{cell['joint_solver']['speedup']:.0f} times faster"],
        ["kernel against the form that writes every pair, one thread", f"{cell['kernel']['speedup']:.0f} times faster, "
         f"{100 * cell['kernel']['memory_ratio']:.0f} % of the memory"],
        ["trials of `carry` a second, all cores", f"{cell['trials']['trials_per_second']:.0f}"],
        ["synthesised grasps that pass `carry`, an hour of a core", f"{cell['synthesis']['valid_per_cpu_hour']:,.0f}"],
    ])


def again(results: Results) -> str:
    """Stored grasps that pass their protocol again."""
    rows = results.cell("data", "again")["again"]
    return table(["trial", "grasps", "held [%]"], [
        [row["trial"], row["asked"], of(round(row["asked"] * row["success"] / 100), row["asked"])] for row in rows])


def state(results: Results) -> str:
    """Of which state and machine the headline is."""
    results.cells("headline")
    cells = list(results.used.values())
    where, weights = cells[0]["machine"], cells[0]["weights"]
    digest = next(v for k, v in weights.items() if "/" not in k)
    return (f"The headline is of commit `{cells[0]['commit']}`, weights `{digest}`, {cells[0]['date']}, on {where['cores']} "
            f"cores of an {where['cpu']}, Python {where['python']}, PyTorch {where['torch'].partition('+')[0]}, "
            f"MuJoCo {where['mujoco']}.")


def gpu(results: Results) -> str:
    """What a GPU does, if one was at hand."""
    found = results.cell("gpu", "table")
    return f"{found['machine']['cuda']}: see `lab/results/gpu.json`."


def training_told(results: Results) -> str:
    """How long the paper's form was trained."""
    (found,) = results.cell("fidelity", "trained")["pretrained"]
    return f"trained for {found['seconds'] / 60:.0f} minutes of one core"


def payload_error(results: Results) -> str:
    """Median error of stated payloads, of trials that were repeated, and of how many grasps."""
    rows = [row for found in results.cells("payload").values() for row in found["rows"]]
    held = [row for row in rows if row["trials"] > payload.INTERVALS[0][0]]
    stated, again = (
        100 * statistics.median(abs(row[way] / row["trials"] - 1) for row in held) for way in (payload.WEIGHED, payload.AGAIN))
    return (f"{stated:.0f} % in the median of {len(held)} grasps (trials repeated: {again:.0f} %; {len(rows) - len(held)} more "
            "held no mass in trials)")


def lifted(results: Results, robot: str) -> str:
    """Share of attempts in which a robot held the object."""
    if not (tried := attempts(results, "lifts", robot)):
        raise MissingResult("lifts")
    held = success_rate(sum(a["success"] for a in tried), len(tried))
    return f"{100 * held[0]:.0f} % [{100 * held[1]:.0f}-{100 * held[2]:.0f}]"


def figure_data(results: Results) -> dict[str, dict[str, Sequence[float]]]:
    """Success and interval of each method under each protocol; nothing where it was not measured."""
    try:
        return _figure_data(results)
    except MissingResult:
        return {}


def _figure_data(results: Results) -> dict[str, dict[str, Sequence[float]]]:
    rows, stages = (results.rows("headline", "validate", ending) for ending in ("returned", "stages"))
    controls = results.rows("headline", "validate", "controls")
    found = {"network alone": average(select(stages, "network", "raw")), "returned by generate": average(rows)}
    found |= {text: average(select(controls, name, "equal-time")) for name, text in CONTROLS.items()}
    return {name: {p: row.success[p] for p in DRAWN} for name, row in found.items()}


def digest(data: object) -> str:
    """Of what a figure shows."""
    return hashlib.sha256(json.dumps(data).encode()).hexdigest()[:16]


def draw_figure(data: dict[str, dict[str, Sequence[float]]], path: Path) -> None:
    """Bars with intervals; the file names the data that it was drawn from."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(8, 3.6), dpi=150)
    width = 0.8 / max(1, len(data))
    for i, (name, rates) in enumerate(data.items()):
        middles = [100 * rate[0] for rate in rates.values()]
        spread = [[100 * abs(rate[0] - rate[k]) for rate in rates.values()] for k in (1, 2)]
        places = [j + (i - (len(data) - 1) / 2) * width for j in range(len(rates))]
        axes.bar(places, middles, 0.92 * width, yerr=spread, capsize=2, label=name, error_kw={"linewidth": 0.8})
    axes.set_xticks(range(len(DRAWN)), DRAWN)
    axes.set_title("" if data else "not measured")
    axes.set_ylabel("held [%], 95 % interval")
    axes.set_ylim(0, 105)
    axes.spines[["top", "right"]].set_visible(False)
    if data:
        axes.legend(frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=3)
    figure.tight_layout()
    figure.savefig(path, metadata={"Description": digest(data)})
    plt.close(figure)


TABLES: dict[str, Callable[[Results], str]] = {
    "headline.short": headline_short,
    "headline.validate": functools.partial(headline_stages, where="validate"),
    "headline.test": functools.partial(headline_stages, where="test"),
    "headline.controls": functools.partial(headline_controls, where="validate"),
    "headline.controls-test": functools.partial(headline_controls, where="test"),
    "headline.diversity": diversity,
    "unseen.hands": unseen,
    "procedural.hands": functools.partial(hands, measurement="procedural"),
    "published.hands": functools.partial(hands, measurement="published"),
    "hard.hands": functools.partial(hands, measurement="hard"),
    "published_hard.hands": functools.partial(hands, measurement="published_hard"),
    "views.views": views,
    "robots.tasks": robot_tasks,
    "robots.planning": planning,
    "robots.control": any_grasp,
    "constraints.cost": constraints,
    "tables.sides": sides,
    "flat.things": flat,
    "confidence.bins": confidence,
    "methods.others": methods,
    "fidelity.form": fidelity,
    "fidelity.simulation": simulation,
    "data.card": data_card,
    "data.labels": labels,
    "speed.commands": commands,
    "speed.parts": parts,
    "data.again": again,
}
"""Tables by name."""
VALUES: dict[str, Callable[[Results], str]] = {
    "results.machine": state,
    "gpu.told": gpu,
    "data.labels-told": labels_told,
    "fidelity.training": training_told,
    "payload.error": payload_error,
    **{f"lifts.{robot}": functools.partial(lifted, robot=robot) for robot in ROBOTS},
}
"""Single numbers by name."""


def writer(name: str, make: Callable[[Results], str], folder: Path = RESULTS) -> str:
    """One table or number; blank cells that are said to be blank where nothing was measured.

    Raises:
        ValueError: Its rows are of several states.
    """
    results = Results(folder)
    try:
        text = make(results)
    except MissingResult as missing:
        return f"not measured (`make results NAMES={missing}`)"
    if found := mixed(results.used):
        raise ValueError(f"{name} would mix states: {', '.join(found)}; run `make results` for what is stale")
    return text


def writers(makers: dict[str, Callable[[Results], str]]) -> pages.Writers:
    """Each table or number, when it is asked for."""
    return {name: functools.partial(writer, name, make) for name, make in makers.items()}


def outdated() -> Iterator[tuple[Path, str]]:
    """Pages that differ from their data, and how they should be."""
    for page in PAGES:
        text = page.read_text()
        if (wanted := pages.rendered(text, writers(TABLES), writers(VALUES))) != text:
            yield page, wanted


def figure_is_old() -> bool:
    """Whether the figure was drawn from other data, or is missing."""
    from PIL import Image

    with Image.open(FIGURE) as image:
        return image.text.get("Description") != digest(figure_data(Results()))  # type: ignore[attr-defined]


def main(argv: Sequence[str] | None = None) -> int:
    """Write, or with --check only say what would be written."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="change nothing; 1 if a page differs from its data")
    options = parser.parse_args(argv)
    changed = [page for page, text in outdated() if options.check or pages.write(page, text)]
    for page in changed:
        print(page.relative_to(ROOT))
    if not options.check:
        draw_figure(figure_data(Results()), FIGURE)
    return int(options.check and bool(changed))


if __name__ == "__main__":
    sys.exit(main())
