"""The paper's comparison: success, diversity and time of several methods under several trials.

    python -m lab.benchmarks.comparison [--methods NAME ...] [--num N] [--trials NAME ...] [--work FOLDER]
                                    [--picture FILE.png] [--json]

Every method returns grasps of the paper's hands on its validate objects, as it does for a user, and each grasp is evaluated
under `dro`, under `dro` with the friction of the official release, and under the other trials. Times are CPU seconds of one
thread for each returned grasp, with all its candidates. `dro:raw` is the network alone, `dro:16` has 16 candidates a grasp,
`dfc=4` is 4 grasps a pair instead of N. With --work, pairs and trials that were measured before are not measured again, so
methods and trials can be added. Needs the development assets by default.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch

from dro_grasp.compare.methods import Method, MethodOptions, make_method
from dro_grasp.compare.metrics import diversity, success_rate
from dro_grasp.compare.stages import pair_seed
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.predict.config import GraspRequest
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.simulation.protocols import changed
from dro_grasp.simulation.trial import simulate
from dro_grasp.training.data.bundle.training_file import load_bundle
from lab.benchmarks.report import emit, rate

RAW = ":raw"
"""Ends the name of a method whose grasps are taken as it makes them, neither refined nor chosen."""
TRIALS = {"dro": changed("dro"), "friction 3": changed("dro", friction=3.0), "strict": changed("strict"),
          "dexgraspbench": changed("dexgraspbench"), "robust": changed("robust")}
"""Trials of a grasp; the official release is `dro` with friction 3."""
HANDS = ("assets/barrett_multidex", "assets/allegro_left", "assets/shadowhand")
"""The paper's hands."""
PAPER = {
    "DFC": ((86.3, 76.21, 58.8), (0.532, 0.454, 0.435), (1800.0, 1800.0, 1800.0)),
    "GenDexGrasp": ((67.0, 51.0, 54.2), (0.488, 0.389, 0.318), (14.67, 25.1, 19.34)),
    "ManiFM": ((np.nan, 42.6, np.nan), (np.nan, 0.288, np.nan), (np.nan, 9.07, np.nan)),
    "D(R,O)": ((87.3, 92.3, 83.0), (0.513, 0.397, 0.441), (0.49, 0.47, 0.98)),
}
"""Success [%], diversity [rad] and seconds on Barrett, Allegro and Shadow hand. Source: paper, table of the overall comparison,
in Isaac Gym; DFC took more than the seconds stated."""
METHODS = ("dro:raw=4", "dro:1=4", "dro", "optimiser:1=4", "optimiser=4", "dfc=4", "gendexgrasp=2",
           "gendexgrasp-gamma1=1", "manifm=4", "start=4")
"""Rows by default."""


def main() -> None:
    """Measure, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", nargs="+", default=list(METHODS),
                        help="as `dro-grasp benchmark --methods`; NAME:raw, NAME:CANDIDATES and NAME=NUM too")
    parser.add_argument("--hands", nargs="+", default=list(HANDS), help="hands")
    parser.add_argument("--objects", nargs="+", default=["assets:validate"], help="objects")
    parser.add_argument("--num", type=int, default=10, help="grasps that each method returns for each hand and object")
    parser.add_argument("--trials", nargs="+", choices=TRIALS, default=list(TRIALS)[:-1], help="trials of every grasp")
    parser.add_argument("--bundle", type=Path, help="training grasps of the mean grasp")
    parser.add_argument("--work", type=Path, help="folder for measured pairs")
    parser.add_argument("--picture", type=Path, help="draw success against time")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    torch.set_num_threads(1)
    hands, objects = [load_hand(name) for name in options.hands], resolve_objects(options.objects)
    options.bundle = options.bundle and load_bundle(options.bundle)
    found: dict[str, dict[str, list[Measured]]] = {}
    for name in options.methods:
        source = Source.of(name, options)
        for hand in filter(source.method.knows, hands):
            found.setdefault(source.name, {})[hand.name] = list(measured(source, hand, objects, options))
    rows = [row for name, per_hand in found.items() for row in lines(name, per_hand, options.trials)]
    columns = ["method", "hand", "n", *(f"{name} [%]" for name in options.trials), "diversity", "shift [mm]", "turn [deg]",
               "CPU s a grasp"]
    emit(f"on each of {len(objects)} objects", rows, columns,
         {f"{row[0]} / {row[1]}": dict(zip(columns[2:], row[2:], strict=True)) for row in rows}, options.json)
    if options.picture is not None:
        draw(found, options.picture)


@dataclass(frozen=True)
class Source:
    """A method, and how it is used."""

    name: str
    method: Method
    raw: bool
    """Whether grasps are taken as the method makes them."""
    num: int
    """Grasps of each hand and object."""

    @staticmethod
    def of(name: str, options: argparse.Namespace) -> Source:
        """A method by its name in the table, such as `dro`, `dro:raw`, `dro:16` or `dfc=4`."""
        name, _, num = name.partition("=")
        plain, _, count = name.rpartition(":") if name.endswith(RAW) or name.rpartition(":")[2].isdigit() else (name, "", "")
        candidates = int(count) if count.isdigit() else GraspRequest.candidates
        method = make_method(plain, MethodOptions(bundle=options.bundle, candidates=candidates))
        return Source(name, method, name.endswith(RAW), int(num or options.num))


@dataclass(frozen=True)
class Measured:
    """Grasps of a pair after their trials."""

    grasps: GraspBatch
    held: dict[str, list[bool]]
    """By trial: which grasps hold."""
    moved: list[list[float]]
    """Shift [m] and turn [rad] of each grasp under `dro`."""
    seconds: float
    """CPU time of a grasp [s]."""


def measured(source: Source, hand: Hand, objects: Sequence[str], options: argparse.Namespace) -> Iterator[Measured]:
    """A method's grasps of a hand on every object, from the work folder where they are there."""
    for obj_name in objects:
        stem = f"{source.name} {hand.name} {obj_name} {source.num}".replace("/", "_").replace(" ", "_")
        stored = options.work and options.work / f"{stem}.parquet"
        known = stored and stored.is_file()
        notes: dict[str, Any] = json.loads(stored.with_suffix(".json").read_text()) if known else {"held": {}}
        missing = {name: TRIALS[name] for name in ("dro", *options.trials) if name not in notes["held"]}
        if known and not missing:
            yield Measured(GraspBatch.load(stored), **notes)
            continue
        obj = load_object(obj_name)
        if known:
            grasps = GraspBatch.load(stored)
        else:
            grasps, notes["seconds"] = made(source, GraspProblem(hand, obj))
        for name, rules in missing.items():
            result = simulate(hand, obj, grasps, rules, workers=1)
            notes["held"][name] = result.success.tolist()
            if name == "dro":
                notes["moved"] = torch.stack([result.displacement[:, -1], result.rotation[:, -1]]).tolist()
        if stored:
            stored.parent.mkdir(parents=True, exist_ok=True)
            stored.with_suffix(".json").write_text(json.dumps(notes))
            grasps.save(stored)
        yield Measured(grasps, **notes)


def made(source: Source, problem: GraspProblem) -> tuple[GraspBatch, float]:
    """Grasps of a pair, and the CPU time of each [s]; what all methods need of an object is not counted."""
    _ = problem.field, problem.obj.parts
    begin, seed, method = time.process_time(), pair_seed(0, problem.hand, problem.obj), source.method
    grasps = (method.propose if source.raw else method.returned)(problem, source.num, seed).grasps
    seconds = (time.process_time() - begin) / source.num
    return grasps.with_asked(method.asked(problem.obj, source.num)), seconds


def lines(name: str, per_hand: dict[str, list[Measured]], trials: Sequence[str]) -> list[list[Any]]:
    """Rows of one method: its hands, and their mean."""
    rows: list[list[Any]] = []
    for hand, parts in per_hand.items():
        rates, good = [outcomes(parts, trial) for trial in trials], outcomes(parts, "dro")
        grasps = GraspBatch.concatenate([p.grasps.replace(extra={}) for p in parts])[torch.from_numpy(good)]
        spread = diversity(grasps.T_object_wrist, grasps.joints)["all"]
        moved = np.concatenate([p.moved for p in parts], 1)[:, good]
        shift, turn = np.nanmean(moved, 1) if good.any() else (np.nan, np.nan)
        asked = sum(p.grasps.out_of for p in parts)
        rows.append([name, hand, asked, *(rate(held, asked) for held in rates), spread, 1e3 * shift, np.degrees(turn),
                     float(np.mean([p.seconds for p in parts]))])
    everything = [p for parts in per_hand.values() for p in parts]
    rates = [outcomes(everything, trial) for trial in trials]
    means = [float(np.nanmean([row[k] for row in rows])) for k in range(-4, 0)]
    asked = sum(row[2] for row in rows)
    return [*rows, [name, "all", asked, *(rate(held, asked) for held in rates), *means]]


def outcomes(parts: Sequence[Measured], trial: str) -> np.ndarray:
    """Which of all grasps hold in a trial."""
    return np.array([held for part in parts for held in part.held[trial]], bool)


def draw(found: dict[str, dict[str, list[Measured]]], path: Path) -> None:
    """Success against time for a grasp, all methods in one picture for each of two trials, the paper's figures in grey."""
    figure, axes = plt.subplots(1, 2, figsize=(13, 4.2), sharey=True, layout="constrained")
    for ax, trial in zip(axes, ("friction 3", "strict"), strict=True):
        for name, per_hand in found.items():
            parts = [p for of_hand in per_hand.values() for p in of_hand]
            held = outcomes(parts, trial)
            share, low, high = success_rate(int(held.sum()), sum(p.grasps.out_of for p in parts))
            seconds = np.mean([p.seconds for p in parts])
            below, above = (100 * max(0.0, part) for part in (share - low, high - share))
            ax.errorbar(seconds, 100 * share, [[below], [above]], fmt="o", capsize=3, label=name)
        ax.set(xscale="log", title=trial, xlabel="time for a returned grasp [s]", ylim=(0, 104))
        ax.grid(alpha=0.3)
    for name, (success, _, seconds) in PAPER.items():
        x, y = np.nanmean(seconds), np.nanmean(success)
        axes[0].plot(x, y, "x", color="grey")
        axes[0].annotate(f"{name}, paper", (x, y), xytext=(6, -4), textcoords="offset points", color="grey")
    axes[0].set(ylabel="success [%]", xlim=(None, 1e5))
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
