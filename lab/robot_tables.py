"""Tables of what robots do: lifts, places, cleared tables, whether a hand holds, times of planning."""

from __future__ import annotations

import functools
from collections import Counter
from typing import Any

from dro_grasp.arm.planning.motion import PLACING
from dro_grasp.compare.metrics import success_rate
from lab.measurements import FLAT_THINGS, ROBOTS, TEST_OBJECTS
from lab.reading import MissingResult, Results, of, state_of, table

TASKS = {"lifts": "lifted, held and shaken", "asked": "the same, of the one asked for among three others",
         "placed": "placed within 2 cm and 15 degrees, of those lifted"}
"""Measurements of attempts, and what they are called."""
LIFTED = {*PLACING, "place", "done"}
"""Where attempts with a place end whose object was in the air."""
HELD_BY, HOLD_NOISES = "watched", ("typical", "pessimistic")
"""What is measured of hands that may hold, and with what noise, in `lab.benchmarks.hold_check`."""


def robot_tasks(results: Results) -> str:
    """What robots do on their tables, and how often they succeed; what was not measured says so.

    Measuring it all takes a night, so that each row has a state of its own, and names it.
    """
    lines = []
    for measure in (*(functools.partial(attempts_line, measurement=name, robot=robot) for name in TASKS for robot in ROBOTS),
                    *(functools.partial(cleared_line, robot=robot) for robot in ROBOTS),
                    *(functools.partial(flat_line, robot=robot) for robot in ROBOTS),
                    *(functools.partial(hold_line, noise=noise) for noise in HOLD_NOISES)):
        own = Results(results.folder)
        line = measure(own)
        lines.append([*line, state_of(f"'{line[0]}'", own.used)])
    return table(["", "asked", "counted", "reached [%]", "ended in", "commit"], lines)


def attempts_line(results: Results, measurement: str, robot: str) -> list[object]:
    """Lifts, and what is put down."""
    made = attempts(results, measurement, robot)
    counted = [a for a in made if a["stage"] in LIFTED] if measurement == "placed" else made
    return counts(f"{TASKS[measurement]}, `{robot}`", measurement, len(made), sum(a["success"] for a in counted), len(counted),
                  endings(made))


def cleared_line(results: Results, robot: str) -> list[object]:
    """Things that leave a table."""
    done = results.some("cleared", robot)
    removed, things, picks = (sum(cell[key] for cell in done) for key in ("removed", "things", "picks"))
    also = f"{picks / removed:.2f} picks each, {sum(cell['tables'] for cell in done)} tables" if removed else ""
    return counts(f"things cleared, six on a table, `{robot}`", "cleared", things, removed, things, also)


def flat_line(results: Results, robot: str) -> list[object]:
    """Lifts of flat things."""
    made = [a for name in FLAT_THINGS for cell in results.some("flat_lifts", f"{robot}, {name}") for a in cell["attempts"]]
    return counts(f"flat and thin things lifted, held and shaken, `{robot}`", "flat_lifts", len(made),
                  sum(a["success"] for a in made), len(made), endings(made))


def hold_line(results: Results, noise: str) -> list[object]:
    """Judgements by the joints."""
    right, n = Counter[str](), Counter[str]()
    for row in hold_rows(results, noise):
        right[row["kind"]] += row[row["truth"]]
        n[row["kind"]] += row["n"]
    also = ", ".join(f"{kind} {right[kind]} of {n[kind]}" for kind in n)
    text = f"held, empty or slipping, by the joints, {noise} noise"
    return counts(text, "holding", n.total(), right.total(), n.total(), also)


def endings(made: list[dict[str, Any]]) -> str:
    """Stages in which attempts ended, and how many."""
    return ", ".join(f"{stage} {count}" for stage, count in Counter(a["stage"] for a in made).items())


def hold_rows(results: Results, noise: str) -> list[dict[str, Any]]:
    """Judgements by the joints with this noise, by hand and kind."""
    return [row for cell in results.some("holding") for row in cell["rows"]
            if row["hand"] != "all" and row["measured"] == HELD_BY and row["noise"] == noise]


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


def lifted(results: Results, robot: str) -> str:
    """Share of attempts in which a robot held the object."""
    if not (tried := attempts(results, "lifts", robot)):
        raise MissingResult("lifts")
    held = success_rate(sum(a["success"] for a in tried), len(tried))
    return f"{100 * held[0]:.0f} % [{100 * held[1]:.0f}-{100 * held[2]:.0f}]"
