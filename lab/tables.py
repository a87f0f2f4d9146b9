"""Tables, numbers and figures of README and docs, from the data in lab/results.

    python -m lab.tables [--check]

A table is of one state: its rows come from the same code and the same weights. What was not measured says so.
"""

from __future__ import annotations

import argparse
import functools
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from dro_grasp.compare.rows import average
from lab import pages, targets
from lab.benchmarks.report import ROOT
from lab.figure import CONTROLS, FIGURES, METHODS
from lab.measurements import ROBOTS
from lab.reading import (
    HEAD,
    MissingResult,
    Results,
    as_row,
    confidence_bins,
    line,
    of,
    payload_errors,
    plain,
    select,
    state_of,
    table,
    with_half,
)
from lab.robot_tables import any_grasp, lifted, planning, robot_tasks
from lab.runner import RESULTS

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
"""Pages that have markers."""
PAPER = {"DFC": (86.3, 76.2, 58.8), "GenDexGrasp": (67.0, 51.0, 54.2), "ManiFM-style": (None, 42.6, None),
         "D(R,O)": (87.3, 92.3, 83.0)}
"""Success on Barrett, Allegro and Shadow hand [%]. Source: paper, table of the overall comparison, in Isaac Gym."""
STAGES = {"raw": "network alone", "refined": "refined", "settled": "refined, settled",
          "settled, ranked": "the best quarter of these by score"}
"""Stages of the network's grasps, and what they are called."""


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


def half(results: Results) -> str:
    """What is returned with half of the candidates, beside all of them."""
    lines = []
    for where, text in (("validate", "the paper's objects"), ("test", "built-in test objects"), ("hard", "hard objects")):
        every, halved = with_half(results, where)
        lines += [line(f"{text}, four candidates", every), line(f"{text}, two", halved)]
    return table(HEAD, lines)


def views(results: Results) -> str:
    """What is seen of the object, and what holds."""
    text = {"cloud": "points of the whole surface", "half": "half of the points, as in the paper", "depth": "one depth image"}
    return table(HEAD, [line(text[view], average(results.rows("views", view))) for view in text])


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


def confidence(results: Results, in_part: bool) -> str:
    """Predicted beside observed, in ten bins."""
    return table(["confidence [%]", "grasps", "predicted [%]", "held [%]"], [
        [f"{10 * b.tenth} to {10 * b.tenth + 10}", b.n, f"{100 * b.predicted:.0f}", of(b.held, b.n)]
        for b in confidence_bins(results, in_part)])


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
    columns = {
        "hand": "hand", "grasps": "grasps", "kept": "kept", "kept [%]": "kept [%]", "made anew": "made anew",
        "diversity": "diversity", "of kept": "diversity of kept", "wrist": "wrist", "of kept wrist": "wrist of kept",
        "joints": "joints", "of kept joints": "joints of kept", "all six half-axes [%]": "six sides [%]",
        "of kept half-axes [%]": "six sides of kept [%]"}
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
        ["synthesized grasps that pass `carry`, an hour of a core", f"{cell['synthesis']['valid_per_cpu_hour']:,.0f}"],
    ])


def scaling(results: Results) -> str:
    """As many shards for each process, however many there are."""
    return table(("engine", "processes", "shards", "time [s]", "efficiency", "CPU of the head [s]", "kB a shard"), [
        [engine, row["processes"], row["shards"], f"{row['time [s]']:.1f}", f"{row['efficiency']:.2f}",
         f"{row['CPU of the head [ms a shard]'] * row['shards'] / 1e3:.2f}", f"{row['bytes a shard'] / 1e3:.1f}"]
        for engine in ("local", "ray") for row in results.cell("scaling", engine)["rows"]])


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
    confirmed = cells[0].get("confirmed")
    again = "" if confirmed is None else (
        f" Its command *{confirmed['by']}* gives the same numbers at commit `{confirmed['commit']}`.")
    return (f"The headline is of commit `{cells[0]['commit']}`, weights `{digest}`, {cells[0]['date']}, on {where['cores']} "
            f"cores of an {where['cpu']}, Python {where['python']}, PyTorch {where['torch'].partition('+')[0]}, "
            f"MuJoCo {where['mujoco']}.{again}")


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
    stated, again, held, none = payload_errors(results)
    return (f"{stated:.0f} % in the median of {held} grasps (trials repeated: {again:.0f} %; {none} more held no mass in "
            "trials)")


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
    "half.objects": half,
    "hard.hands": functools.partial(hands, measurement="hard"),
    "published_hard.hands": functools.partial(hands, measurement="published_hard"),
    "views.views": views,
    "robots.tasks": robot_tasks,
    "robots.planning": planning,
    "robots.control": any_grasp,
    "constraints.cost": constraints,
    "tables.sides": sides,
    "flat.things": flat,
    "confidence.bins": functools.partial(confidence, in_part=False),
    "confidence.in-part": functools.partial(confidence, in_part=True),
    "methods.others": methods,
    "fidelity.form": fidelity,
    "fidelity.simulation": simulation,
    "data.card": data_card,
    "data.labels": labels,
    "speed.commands": commands,
    "speed.parts": parts,
    "data.again": again,
    "data.scaling": scaling,
    "targets.all": targets.all_targets,
}
"""Tables by name."""
VALUES: dict[str, Callable[[Results], str]] = {
    "results.machine": state,
    "gpu.told": gpu,
    "targets.told": targets.told,
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
    state_of(name, results.used)
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


def main(argv: Sequence[str] | None = None) -> int:
    """Write, or with --check only say what would be written."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="change nothing; 1 if a page differs from its data")
    options = parser.parse_args(argv)
    changed = [page for page, text in outdated() if options.check or pages.write(page, text)]
    for page in changed:
        print(page.relative_to(ROOT))
    if not options.check:
        for each in FIGURES:
            each.draw(each.data(Results()), each.path)
    return int(options.check and bool(changed))


if __name__ == "__main__":
    sys.exit(main())
