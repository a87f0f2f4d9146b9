"""Trials on a device beside the processor's: how many verdicts agree, how many run in a second, and what settling takes.

Agreement is of stored grasps, which hold under `strict`: the same number of each hand, all those of its first training objects
until the number is full. The device runs them all, also those of an object with few. Speed is of the network's refined
candidates of one hand and object, repeated, without the processor's confirmation. Settling is that of the same candidates, by
part.

    python -m lab.benchmarks.device_trials [--device cuda] [--grasps FILE ...] [--num N] [--protocols NAME ...]
        [--worlds N ...] [--settled N] [--hand HAND] [--object NAME] [--pack FOLDER] [--record FILE] [--json]

Stored grasps are of development assets. `--pack` measures nothing: it copies what these grasps need, a megabyte, into a
folder that is DRO_GRASP_ASSETS on another machine. `--device warp` is MuJoCo Warp on the processor: about one closing a second.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from dro_grasp.devices import cores
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.predict import settling, stages
from dro_grasp.predict.finish import FinishConfig
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.network import NetworkSource, ProposalConfig
from dro_grasp.predict.sources.source import ask
from dro_grasp.simulation import grasp_state, rollout as rollout_module, trial
from dro_grasp.simulation.rollout import Rollout, rollouts
from dro_grasp.simulation.scene import scene_of
from dro_grasp.simulation.trial import TrialResult, simulate
from dro_grasp.simulation.worlds import require_worlds
from lab.benchmarks.agreement import kappa
from lab.benchmarks.report import emit, note, options_of, rate
from lab.measurements import STORED

DIFFERENT = 64
"""Grasps that are repeated until they fill the worlds."""
COLUMNS = ("what", "grasps", "held on the processor [%]", "held on the device [%]", "same", "same [%]", "kappa", "a second")


def shares(grasps: GraspBatch, num: int) -> Iterator[tuple[str, Int[Tensor, " k"]]]:
    """Names of the first training objects, and rows of their grasps, until these are as many as the number."""
    rows: dict[str, list[int]] = {}
    for row in [row for row, split in enumerate(grasps.split) if split == "train"]:
        rows.setdefault(grasps.object[row], []).append(row)
    for name, own in rows.items():
        if num > 0:
            yield name, torch.tensor(own[:num])
        num -= len(own)


def pack(paths: Sequence[Path], num: int, folder: Path) -> None:
    """Copy the meshes and convex parts of the objects that agreement is measured on, with a list of them alone."""
    source = Path(os.environ["DRO_GRASP_ASSETS"]) / "objects"
    names = {name for path in paths for name, _ in shares(GraspBatch.load(path), num)}
    entries = [entry for entry in json.loads((source / "manifest.json").read_text()) if entry["name"] in names]
    for file in (entry["file"] for own in entries for entry in (own, own["collision"]) if entry):
        (target := folder / "objects" / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(source / file, target)
    (folder / "objects" / "manifest.json").write_text(json.dumps(entries))


ON_THE_DEVICE = patch.object(rollout_module, "FEW", 0)
"""Lets the device run few grasps too, which the processor would do sooner: it would be compared with itself."""


@ON_THE_DEVICE
def agreement(path: Path, protocol: str, options: argparse.Namespace) -> list[list[object]]:
    """A line for a file of grasps; what disagrees is printed."""
    grasps, results = GraspBatch.load(path), []
    hand = load_hand(grasps.hand)
    seconds = 0.0
    for name, rows in shares(grasps, options.num):
        obj, own = load_object(name), grasps[rows]
        first = simulate(hand, obj, own, protocol)
        begin = time.perf_counter()
        second = simulate(hand, obj, own, protocol, device=options.device, confirm=False)
        seconds += time.perf_counter() - begin
        tell(f"{hand.name} {name} {protocol}", first, second)
        results.append((first.success, second.success))
        one, other = (torch.cat(column) for column in zip(*results, strict=True))
        note(options.record, f"agreement, {path.stem}, {protocol}", device=options.device, same=int((one == other).sum()),
             grasps=len(one), asked=options.num, seconds=seconds)
    one, other = (torch.cat(column) for column in zip(*results, strict=True))
    return [compared(f"{hand.name}, {protocol}", one, other, len(one) / seconds)]


def compared(what: str, one: Bool[Tensor, " n"], other: Bool[Tensor, " n"], speed: float) -> list[object]:
    """A line of the table, which is printed at once."""
    same = one == other
    line: list[object] = [what, len(one), rate(one), rate(other), int(same.sum()), rate(same), kappa(one, other), speed]
    print(*line, file=sys.stderr, flush=True)
    return line


def tell(what: str, first: TrialResult, second: TrialResult) -> None:
    """Print why verdicts differ."""
    for i in (first.success != second.success).nonzero()[:, 0].tolist():
        said = " / ".join(
            f"{one.reason[i] or 'held'} (closing {1e3 * float(one.closing_shift[i]):.1f} mm, "
            f"largest {1e3 * float(one.displacement[i].nan_to_num().max()):.1f} mm)" for one in (first, second))
        print(f"  {what}, grasp {i}: {said}", file=sys.stderr, flush=True)


def candidates(problem: GraspProblem, num: int) -> GraspBatch:
    """The network's grasps, refined."""
    made = ask(NetworkSource(GraspPredictor(device=str(problem.device)).network, ProposalConfig()), problem, num, 0)
    return stages.complete(problem, stages.refine(problem, made.grasps, FinishConfig().refine))


@ON_THE_DEVICE
def speed(grasps: GraspBatch, worlds: int, options: argparse.Namespace) -> list[list[object]]:
    """Closings and whole strict trials a second, warm, and how many verdicts are those of the processor."""
    hand, obj = load_hand(options.hand), load_object(options.object)
    many = grasps[torch.arange(worlds) % len(grasps)]
    rows: list[list[object]] = []
    expected = simulate(hand, obj, grasps, "strict").success[torch.arange(worlds) % len(grasps)]

    def close() -> Bool[Tensor, " n"]:
        scene = scene_of(hand, obj, many, "strict")
        return torch.cat([torch.from_numpy(rollout.close().stable) for _, rollout in rollouts(
            scene, hand, many, None, device=options.device)])

    def whole() -> Bool[Tensor, " n"]:
        return simulate(hand, obj, many, "strict", device=options.device, confirm=False).success

    for what, run in (("closings", close), ("whole strict trials", whole)):
        run()
        begin = time.perf_counter()
        found = run()
        known = expected if run is whole else torch.ones_like(found)
        seconds = time.perf_counter() - begin
        note(options.record, what, device=options.device, rate=worlds / seconds, worlds=worlds,
             same=int((known == found).sum()))
        rows.append(compared(f"{what}, {worlds} at once", known, found, worlds / seconds))
    return rows


PARTS = (
    (settling, "settle_many"), (settling, "pressed_many"), (settling, "grasp_state_many"), (settling, "refine_all"),
    (settling, "grip_all"),
    (settling, "deepest_penetration"), (grasp_state.Pressed, "payloads"), (grasp_state, "contact_forces"),
    (grasp_state, "squeezes_of"), (grasp_state, "unanswered"), (grasp_state, "pierced"), (trial, "find_contact_links"),
    (Rollout, "_advance"),
)
"""Functions whose time is told; the later ones are parts of the first three, and the last is the steps of time alone."""
LONG = 0.5
"""What takes longer is told at once [s]."""


@contextmanager
def timed() -> Iterator[dict[str, float]]:
    """Seconds of each of PARTS within the block."""
    seconds: dict[str, float] = {}
    before = [(owner, name, getattr(owner, name)) for owner, name in PARTS]

    def watched(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def run(*given: Any, **named: Any) -> Any:
            begin = time.perf_counter()
            result = function(*given, **named)
            spent = time.perf_counter() - begin
            seconds[name] = seconds.get(name, 0.0) + spent
            if spent > LONG:
                print(f"  {name} {spent:.2f} s", file=sys.stderr, flush=True)
            return result
        return run

    for owner, name, function in before:
        setattr(owner, name, watched(name, function))
    try:
        yield seconds
    finally:
        for owner, name, function in before:
            setattr(owner, name, function)


def settled(problem: GraspProblem, grasps: GraspBatch) -> None:
    """Print what settling these grasps takes, by part, the first time and warm."""
    for when in ("cold", "warm"):
        with timed() as seconds:
            begin = time.perf_counter()
            stable = settling.settle_all([problem], [grasps])[0].stable
            whole = time.perf_counter() - begin
        parts = ", ".join(f"{name} {value:.2f} s" for name, value in seconds.items())
        print(f"{when}: settled {len(grasps)} in {whole:.2f} s on {problem.device}, {len(grasps) / whole:.0f} a second, "
              f"{int(stable.sum())} hold still; of that: {parts}", file=sys.stderr, flush=True)


def main(argv: list[str] | None = None) -> None:
    """Measure and print."""
    parser = options_of(__doc__)
    parser.add_argument("--device", default="cuda", help="what is compared with the processor; warp: its own")
    parser.add_argument("--grasps", nargs="*", type=Path, default=list(STORED), help="files of stored grasps")
    parser.add_argument("--num", type=int, default=400, help="grasps of each file")
    parser.add_argument("--protocols", nargs="+", default=["strict", "carry"])
    parser.add_argument("--worlds", nargs="*", type=int, default=[4096], help="trials at once, for their speed")
    parser.add_argument("--settled", type=int, default=1024, help="grasps to settle; 0: none")
    parser.add_argument("--hand", default="allegro")
    parser.add_argument("--object", default="rubber_duck")
    parser.add_argument("--pack", type=Path, help="copy the assets that the stored grasps need there, and measure nothing")
    parser.add_argument("--record", type=Path, help="file to which each result is appended as it is found")
    options = parser.parse_args(argv)
    if options.pack:
        return pack(options.grasps, options.num, options.pack)
    require_worlds(options.device)
    lines = [line for path in options.grasps for name in options.protocols for line in agreement(path, name, options)]
    device = "cpu" if options.device == "warp" else options.device
    if options.worlds or options.settled:
        problem = GraspProblem(load_hand(options.hand), load_object(options.object), device)
        grasps = candidates(problem, max(DIFFERENT, options.settled))
        lines += [line for worlds in options.worlds for line in speed(grasps[:DIFFERENT], worlds, options)]
        if options.settled:
            settled(problem, grasps[:options.settled])
    emit(f"Trials on {options.device} and on the processor ({cores()} cores)", lines, COLUMNS,
         {"rows": [dict(zip(COLUMNS, line, strict=True)) for line in lines]}, options.json)


if __name__ == "__main__":
    main()
