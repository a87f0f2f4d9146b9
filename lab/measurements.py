"""What is measured for a release: named measurements, each of which is some commands that print one JSON object.

`python -m lab.runner` runs them, `python -m lab.tables` writes what README and docs tell of them. Nothing may be chosen by what
is measured here.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from dro_grasp.predict.config import GraspRequest
from lab.published_hands import HANDS as PUBLISHED

PREPARED = "out/results"
"""Folder of what commands need and make once: `PREPARATIONS`."""
LABELS = "data/labels"
"""Folder that `make labels` fills in hours, pair by pair; committed on the way, another machine goes on."""
TRIED = 24
"""Of a pair of hand and object, so many of the shipped grasps are tried as labels, whose palm directions differ most."""
PAPER_HANDS = ("assets/barrett_multidex", "assets/allegro_left", "assets/shadowhand")
"""The hands of the paper."""
UNSEEN_HANDS = ("assets/inspire", "assets/ability", "assets/dclaw", "assets/ezgripper", "assets/orca")
"""Hands that no weights were trained on."""
FLAT_HANDS = ("assets/leaphand", "assets/shadowhand", "gripper3")
"""Hands that pick flat things from a table."""
OBJECTS = {"validate": "assets:validate", "test": "builtin:test"}
"""Objects that no weights were trained on: the paper's, by which the form of the network was once chosen, and built-in ones."""
HARD = "builtin:hard_test"
"""Thin, flat, hollow, small, large and heavy ones, on which no setting was chosen."""
MADE_HANDS = 10
"""Procedural hands, with seeds that no training used."""
HALF = GraspRequest.candidates // 2
"""Half of the candidates that `generate` makes at most for each grasp."""
FLAT_THINGS = ("ballpoint_pen", "bank_card", "dinner_plate", "table_fork", "hardcover_book", "scissors")
"""Flat and thin things, on which no setting was chosen."""
ROBOTS = ("xarm7_leaphand", "ur5e_allegro")
"""Built-in arms with hands."""
ROBOT_HANDS = ("leaphand", "allegro")
"""Their hands."""
TEST_OBJECTS = ("camera", "chess_pawn", "lemon", "mug", "rubber_duck", "screwdriver", "soap", "spray_bottle", "teapot",
                "wine_glass")
"""Those of `builtin:test`, one a command."""
TABLES = 6
"""Tables that each robot clears."""
STORED = tuple(Path("data/grasps") / f"{name}.parquet" for name in ("allegro", "barrett", "shadowhand"))
"""Stored grasps that a device judges as well."""
SEEN_IN_PART = "seen in part"  # End of the names of cells of one depth image
FAST, ALL = "carry dexgraspbench strict", "carry robust dexgraspbench strict"
"""Protocols: those of one trial a grasp, and with the one of eight. Beside the paper stands its own as well: `dro`."""
CORE = ("devices.py", "frames.py", "kinds.py", "geometry", "network", "objects", "hands", "distance_matrix.py", "grasps",
        "optimize", "simulation", "predict")
"""What turns a hand and an object into grasps and tries them; all measurements rest on it."""
PREPARATIONS = {
    "bundle.safetensors": "dro-grasp dataset bundle data/grasps --hands " + " ".join(PAPER_HANDS)
    + f" --output {PREPARED}/bundle.safetensors",
    "tried": f"dro-grasp dataset merge data/grasps --output {PREPARED}/tried --per-pair {TRIED}",
    "made_hands": f"dro-grasp hand make --seed 9000 --num {MADE_HANDS} --output {PREPARED}/made_hands",
    "published": f"python -m lab.published_hands {PREPARED}/published",
}
"""Commands that make the files of PREPARED, by name."""


@dataclass(frozen=True)
class Measurement:
    """One question to the product, in as many commands as make resuming cheap."""

    title: str
    cells: Mapping[str, str] = field(repr=False)  # Commands by name
    wings: tuple[str, ...] = ("compare",)  # What it rests on beside CORE, in src/dro_grasp
    alone: bool = False  # Whether nothing may run beside it, as for times of the whole machine
    needs: str = ""  # Folder without which it is skipped; what fills it takes too long to be run on the way
    device: str = "cpu"  # What it needs; a measurement of `cuda` is skipped where there is none


def _short(name: str) -> str:
    return name.rpartition("/")[2]


def _benchmark(methods: str, hands: str, objects: str, options: str) -> str:
    return f"dro-grasp benchmark --methods {methods} --hands {hands} --objects {objects} {options} --json"


def _headline() -> dict[str, str]:
    cells = {}
    for where, objects in OBJECTS.items():
        for hand in PAPER_HANDS:
            name = f"{where}, {_short(hand)}"
            cells[f"{name}, returned"] = _benchmark(
                "auto", hand, objects, f"--num 32 --stages returned --protocols {ALL} dro")
            cells[f"{name}, stages"] = _benchmark(
                "network", hand, objects, f"--num 12 --stages raw refined settled --protocols {FAST} dro")
            cells[f"{name}, controls"] = _benchmark(
                "auto optimiser start mean-grasp", hand, objects,
                f"--num 16 --stages equal-time --protocols {FAST} --bundle {PREPARED}/bundle.safetensors")
    return cells


def _half() -> dict[str, str]:
    return {f"{where}, {_short(hand)}": _benchmark(
        "auto", hand, objects, f"--num 32 --candidates {HALF} --stages returned --protocols {FAST}")
        for where, objects in (OBJECTS | {"hard": HARD}).items() for hand in PAPER_HANDS}


def _unseen() -> dict[str, str]:
    cells = {}
    for hand in UNSEEN_HANDS:
        cells[f"{_short(hand)}, returned"] = _benchmark(
            "auto", hand, OBJECTS["validate"], f"--num 16 --stages returned --protocols {ALL}")
        cells[f"{_short(hand)}, sources"] = _benchmark(
            "network optimiser", hand, OBJECTS["validate"], f"--num 16 --stages returned --protocols {FAST}")
        cells[f"{_short(hand)}, network alone"] = _benchmark(
            "network", hand, OBJECTS["validate"], f"--num 12 --stages raw --protocols {FAST} dro")
    return cells


def _confidence() -> dict[str, str]:
    groups = {_short(hand): f"--hands {hand}" for hand in (*PAPER_HANDS, *UNSEEN_HANDS)} | {"made": f"--made {MADE_HANDS}"}
    whole = {f"{group}, {name}": f"python -m lab.studies.confidence {hands} --objects {objects} --num 8 --json"
             for group, hands in groups.items() for name, objects in (("test", OBJECTS["test"]), ("hard", "builtin:hard_test"))}
    return whole | {
        f"{_short(hand)}, {SEEN_IN_PART}": f"python -m lab.studies.confidence --hands {hand} --objects {OBJECTS['test']} "
        "--view depth --num 8 --json" for hand in PAPER_HANDS}


def _lifts(robot: str, row: str, objects: str, attempts: int, options: str = "") -> str:
    # Without --output: what a folder keeps may be of other code.
    return (f"python -m lab.benchmarks.lifts --robots {robot} --rows {row} --objects {objects} --attempts {attempts} "
            f"{options}--json")


def _attempts(row: str, attempts: int) -> dict[str, str]:
    return {f"{robot}, {name}": _lifts(robot, row, name, attempts) for robot in ROBOTS for name in TEST_OBJECTS}


MEASUREMENTS = {
    "headline": Measurement(
        "The paper's hands on objects that no weights were trained on, with controls of equal time", _headline()),
    "unseen": Measurement("Hands that no weights were trained on, on the paper's validate objects", _unseen()),
    "procedural": Measurement("Hands that exist nowhere", {
        f"hand {9000 + i}": _benchmark(
            "auto", f"{PREPARED}/made_hands/hand_{9000 + i:05}.urdf", OBJECTS["validate"],
            f"--num 8 --stages returned --protocols {FAST}")
        for i in range(MADE_HANDS)}),
    "published": Measurement("Hands as others publish them, on the built-in test objects", {
        name: _benchmark("auto", shlex.quote(f"{PREPARED}/published/{path}"), OBJECTS["test"],
                         f"--num 16 --stages returned --protocols {ALL}")
        for name, path in PUBLISHED.items()}),
    "hard": Measurement("The paper's hands on hard objects", {
        _short(hand): _benchmark("auto", hand, HARD, f"--num 32 --stages returned --protocols {ALL}")
        for hand in PAPER_HANDS}),
    "half": Measurement("The same three groups of objects, with half of the candidates", _half()),
    "published_hard": Measurement("Hands as others publish them, on hard objects", {
        name: _benchmark("auto", shlex.quote(f"{PREPARED}/published/{path}"), HARD,
                         f"--num 32 --stages returned --protocols {ALL}")
        for name, path in PUBLISHED.items()}),
    "confidence": Measurement(
        "Whether confidence is how often grasps hold, on hands and objects that no weights were trained on", _confidence()),
    "payload": Measurement("The payload that `generate` states, beside trials with growing mass", {
        _short(hand): f"python -m lab.studies.payload --hands {hand} --objects assets:validate --pairs 6 --grasps 4 --json"
        for hand in UNSEEN_HANDS}),
    "views": Measurement("The paper's hands on objects seen in part", {
        f"{view}, {_short(hand)}": _benchmark(
            "auto", hand, OBJECTS["validate"], f"--view {view} --num 16 --stages returned --protocols {FAST}")
        for view in ("cloud", "half", "depth") for hand in PAPER_HANDS}),
    "lifts": Measurement("Arms that see an object in one depth image, plan, grasp, lift, hold and shake it", {
        **_attempts("cloud", 10), **{f"{robot}, any grasp": _lifts(robot, "random", OBJECTS["test"], 5) for robot in ROBOTS},
    }, wings=("arm", "compare")),
    "asked": Measurement("The same, of the thing that is asked for among three others", _attempts("asked", 3),
                         wings=("arm", "compare")),
    "placed": Measurement("Objects that are lifted and put down at a random place", _attempts("place", 5),
                          wings=("arm", "compare")),
    "cleared": Measurement("Tables with six things that are cleared into a bin", {
        f"{robot}, table {seed}": f"dro-grasp clear --robot {robot} --objects {OBJECTS['test']} --things 6 --seed {seed} --json"
        for robot in ROBOTS for seed in range(TABLES)}, wings=("arm", "compare")),
    "holding": Measurement("Whether a hand holds, is empty or slips, by its joints alone", {
        hand: f"python -m lab.benchmarks.hold_check --generated --hands {hand} --group {OBJECTS['test']} --objects 10 "
        "--grasps 6 --most 34 --json" for hand in ROBOT_HANDS}),
    "planning": Measurement("Times from the image of a scene to a plan, nothing beside", {
        robot: _lifts(robot, "asked", OBJECTS["test"], 2, "--seed 1 ") for robot in ROBOTS
    }, wings=("arm", "compare"), alone=True),
    "constraints": Measurement("What constraints cost, and whether what is returned respects them", {
        name: "python -m lab.benchmarks.constraints --cases " + shlex.quote(name) + " --json"
        for name in ("nothing", "direction", "max_tilt", "obstacles", "contact_region", "keep_out", "pregrasp_clearance")}),
    "tables": Measurement("Objects that rest on a table, from above and from the side", {
        hand: f"python -m lab.benchmarks.tabletop --hands {hand} --objects builtin:test --num 8 --trials carry --json"
        for hand in ("allegro", "barrett")}),
    "flat": Measurement("Flat and thin things on a table, from above, carried", {
        _short(hand): f"python -m lab.benchmarks.tabletop --hands {hand} --objects ballpoint_pen bank_card dinner_plate "
        "table_fork hardcover_book scissors --num 8 --sides above --trials carry --json" for hand in FLAT_HANDS}),
    "flat_lifts": Measurement("Flat and thin things that an arm takes from a table, after a push to its edge if need be", {
        f"{robot}, {name}": f"python -m lab.benchmarks.flat_lifts --robot {robot} --object {name} --attempts 5 --json"
        for robot in ROBOTS for name in FLAT_THINGS}, wings=("arm", "compare")),
    "methods": Measurement("Methods of others, written anew here, beside ours", {
        f"{method}, {_short(hand)}": _benchmark(source, hand, OBJECTS["validate"], f"--num {num} --stages raw returned "
                                                f"--protocols {FAST} dro")
        for hand in PAPER_HANDS
        for method, source, num in (
            ("DFC", "dfc", 8), ("GenDexGrasp", "lab.methods.gendexgrasp:GenDexGrasp", 4),
            ("ManiFM-style", "lab.methods.manifm:ContactMethod", 8))
        if method != "ManiFM-style" or "allegro" in hand}),
    "fidelity": Measurement("The paper's own form, slim, trained as far as an hour of one core goes; and finer simulation", {
        "simulation": "python -m lab.benchmarks.agreement --num 8 --json",
        "trained": f"python -m lab.studies.paper_form --bundle {PREPARED}/bundle.safetensors --output {PREPARED}/paper_form "
        "--rows pretrained --seeds 0 --steps 1500 --pretraining-steps 500 --num 8 --json"}, wings=("compare", "training")),
    "data": Measurement("The grasps that ship with the repository", {
        "card": "python -m lab.benchmarks.data_card --json",
        "again": "python -m lab.benchmarks.dataset data/grasps --sample 60 --json"}, wings=("compare", "training")),
    "labels": Measurement("What `carry` and `robust` leave of these grasps, and of their diversity", {
        "kept": f"python -m lab.benchmarks.data_card {PREPARED}/tried --labels {LABELS} --json"}, wings=("compare", "training"),
        needs=LABELS),
    "speed": Measurement("Times on the processor, nothing beside", {
        name: f"python -m lab.benchmarks.{name} {options}--json" for name, options in (
            ("commands", "--runs 3 "), ("inference", ""), ("returned", ""), ("joint_solver", ""), ("kernel", ""),
            ("trials", "--protocol carry "), ("synthesis", "--protocol carry "))},
        wings=("compare", "training", "cli"), alone=True),
    "agreement": Measurement("Verdicts of MuJoCo Warp, on the processor, beside MuJoCo's", {
        path.stem: "python -m lab.benchmarks.device_trials --device warp --worlds --settled 0 --protocols strict "
        f"--grasps {path} --json" for path in STORED}),
    "scaling": Measurement("Weak scaling of the data engine", {
        engine: f"python -m lab.benchmarks.workers --engine {engine} --json" for engine in ("local", "ray")},
        wings=("training",), alone=True),
    "gpu": Measurement("Times on a GPU", {
        "table": "python -m lab.benchmarks.gpu_table --json"}, wings=("training",), alone=True, device="cuda"),
}
"""Everything that README and docs tell, by name."""
