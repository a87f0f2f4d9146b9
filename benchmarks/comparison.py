"""The paper's comparison: success, diversity and time of several methods, under the paper's friction and under ours.

    python benchmarks/comparison.py [--methods NAME ...] [--num N] [--work FOLDER] [--picture FILE.png] [--json]

Every method returns grasps of the paper's hands on its validate objects, as it does for a user, and each grasp is evaluated
under `dro`, under `dro` with the friction of the official release, and under `strict`. Times are CPU seconds of one thread for
each returned grasp, with all its candidates. `dro:raw` is the network alone. With --work, pairs that were measured before are
not measured again, so further methods can be added. Needs the development assets by default.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from report import emit

from dro_grasp.baselines.method import Method
from dro_grasp.baselines.registry import MethodOptions, make_method
from dro_grasp.datasets.bundle.training_file import load_bundle
from dro_grasp.evaluation.metrics import diversity, wilson_interval
from dro_grasp.evaluation.success_rates import pair_seed
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.pipeline.problem import GraspProblem
from dro_grasp.simulation.protocols import changed
from dro_grasp.simulation.trial import simulate

RAW = ":raw"
"""Ends the name of a method whose grasps are taken as it makes them, neither refined nor chosen."""
TRIALS = {"dro": changed("dro"), "dro, friction 3": changed("dro", friction=3.0), "strict": changed("strict")}
"""Trials of every grasp; the official release has friction 3."""
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
METHODS = ("dro:raw", "dro", "synthesise", "dfc", "start")
"""Rows by default."""


def main() -> None:
    """Measure, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", nargs="+", default=list(METHODS), help="as `dro-grasp benchmark --methods`; NAME:raw too")
    parser.add_argument("--hands", nargs="+", default=list(HANDS), help="hands")
    parser.add_argument("--objects", nargs="+", default=["assets:validate"], help="objects")
    parser.add_argument("--num", type=int, default=4, help="grasps that each method returns for each hand and object")
    parser.add_argument("--bundle", type=Path, help="training grasps of the mean grasp")
    parser.add_argument("--work", type=Path, help="folder for measured pairs")
    parser.add_argument("--picture", type=Path, help="draw success against time")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    torch.set_num_threads(1)
    hands, objects = [load_hand(name) for name in options.hands], resolve_objects(options.objects)
    bundle = None if options.bundle is None else load_bundle(options.bundle)
    found: dict[str, dict[str, list[Measured]]] = {}
    for name in options.methods:
        method = make_method(name.removesuffix(RAW), MethodOptions(bundle=bundle))
        for hand in filter(method.knows, hands):
            found.setdefault(name, {})[hand.name] = list(measured(name, method, hand, objects, options))
    rows = [row for name, per_hand in found.items() for row in lines(name, per_hand)]
    columns = ["method", "hand", "n", *(f"{name} [%]" for name in TRIALS), "diversity", "shift [mm]", "turn [deg]",
               "CPU s a grasp"]
    emit(f"{options.num} grasps of each hand on each of {len(objects)} objects", rows, columns,
         {f"{row[0]} / {row[1]}": dict(zip(columns[2:], row[2:], strict=True)) for row in rows}, options.json)
    if options.picture is not None:
        draw(found, options.picture)


class Measured:
    """Grasps of a pair after all trials."""

    def __init__(self, grasps: GraspBatch, held: np.ndarray, moved: np.ndarray, seconds: float) -> None:
        self.grasps, self.seconds = grasps, seconds
        self.held, self.moved = held, moved  # per trial and grasp; shift [m] and turn [rad] of each grasp under dro


def measured(
    name: str, method: Method, hand: Hand, objects: Sequence[str], options: argparse.Namespace
) -> Iterator[Measured]:
    """A method's grasps of a hand on every object, from the work folder where they are there."""
    for obj_name in objects:
        stem = f"{name} {hand.name} {obj_name} {options.num}".replace("/", "_").replace(" ", "_")
        stored = options.work and options.work / f"{stem}.parquet"
        if stored and stored.is_file():
            notes = json.loads(stored.with_suffix(".json").read_text())
            yield Measured(GraspBatch.load(stored), np.array(notes["held"]), np.array(notes["moved"]), notes["seconds"])
            continue
        obj = load_object(obj_name)
        grasps, seconds = made(name, method, GraspProblem(hand, obj), options.num)
        held, moved = trials(hand, obj, grasps)
        if stored:
            stored.parent.mkdir(parents=True, exist_ok=True)
            notes = {"held": held.tolist(), "moved": moved.tolist(), "seconds": seconds}
            stored.with_suffix(".json").write_text(json.dumps(notes))
            grasps.save(stored)
        yield Measured(grasps, held, moved, seconds)


def made(name: str, method: Method, problem: GraspProblem, num: int) -> tuple[GraspBatch, float]:
    """Grasps of a pair, and the CPU time of each [s]; what all methods need of an object is not counted."""
    _ = problem.field, problem.obj.parts
    begin, seed = time.process_time(), pair_seed(0, problem.hand, problem.obj)
    grasps = method.make(problem, num, seed) if name.endswith(RAW) else method.best(problem, num, seed).grasps
    return grasps, (time.process_time() - begin) / num


def trials(hand: Hand, obj: ObjectModel, grasps: GraspBatch) -> tuple[np.ndarray, np.ndarray]:
    """Which grasps hold, by trial; shift and turn of the object under the first trial."""
    results = [simulate(hand, obj, grasps, rules, workers=1) for rules in TRIALS.values()]
    first = results[0]
    moved = torch.stack([first.displacement[:, -1], first.rotation[:, -1]])
    return torch.stack([result.success for result in results]).numpy(), moved.double().numpy()


def lines(name: str, per_hand: dict[str, list[Measured]]) -> list[list[Any]]:
    """Rows of one method: its hands, and their mean."""
    rows: list[list[Any]] = []
    for hand, parts in per_hand.items():
        held, moved = np.concatenate([p.held for p in parts], 1), np.concatenate([p.moved for p in parts], 1)
        grasps = GraspBatch.concatenate([p.grasps.replace(extra={}) for p in parts])[torch.from_numpy(held[0])]
        spread = diversity(grasps.T_object_wrist, grasps.joints)["all"]
        shift, turn = np.nanmean(moved[:, held[0]], 1) if held[0].any() else (np.nan, np.nan)
        rows.append([name, hand, held.shape[1], *map(rate, held), spread, 1e3 * shift, np.degrees(turn),
                     float(np.mean([p.seconds for p in parts]))])
    held = np.concatenate([p.held for parts in per_hand.values() for p in parts], 1)
    means = [float(np.nanmean([row[k] for row in rows])) for k in range(-4, 0)]
    return [*rows, [name, "all", held.shape[1], *map(rate, held), *means]]


def rate(held: np.ndarray) -> str:
    """Success in per cent with its 95 % interval."""
    low, high = wilson_interval(int(held.sum()), len(held))
    return f"{100 * held.mean():.1f} [{100 * low:.0f}-{100 * high:.0f}]"


def draw(found: dict[str, dict[str, list[Measured]]], path: Path) -> None:
    """Success against time for a grasp, all methods in one picture for each of two trials, the paper's figures in grey."""
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), sharey=True, layout="constrained")
    for ax, trial in zip(axes, ("dro, friction 3", "strict"), strict=True):
        for name, per_hand in found.items():
            parts = [p for of_hand in per_hand.values() for p in of_hand]
            held = np.concatenate([p.held[list(TRIALS).index(trial)] for p in parts])
            low, high = wilson_interval(int(held.sum()), len(held))
            share, seconds = held.mean(), np.mean([p.seconds for p in parts])
            below, above = (100 * max(0.0, part) for part in (share - low, high - share))
            ax.errorbar(seconds, 100 * share, [[below], [above]], fmt="o", capsize=3, label=name)
        ax.set(xscale="log", title=trial, xlabel="time for a returned grasp [s]", ylim=(0, 104))
        ax.grid(alpha=0.3)
    for name, (success, _, seconds) in PAPER.items():
        x, y = np.nanmean(seconds), np.nanmean(success)
        axes[0].plot(x, y, "x", color="grey")
        axes[0].annotate(f" {name}, paper", (x, y), xytext=(0, -14), textcoords="offset points", ha="center", color="grey")
    axes[0].set(ylabel="success [%]", xlim=(None, 2e4))
    axes[0].legend(loc="lower left")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
