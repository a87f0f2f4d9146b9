"""Valid grasps per CPU-hour, by synthesis, settling and trial together.

The work is the data engine's own: every shard is synthesized, closed, evaluated under a protocol, and its
near-duplicates are counted once. CPU time is that of the process, including model compilation; loading a hand
and an object is counted separately, with grid and convex parts from the cache.

    python -m lab.benchmarks.synthesis [--json] [--full] [--seed 0] [--protocol carry] [--device cuda]
"""

from __future__ import annotations

import json
import os
import random
import sys
import time
from pathlib import Path

import torch

from dro_grasp.grasps.batch import DUPLICATE_DISTANCE
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimize.synthesis import SynthesisConfig
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, PROTOCOLS
from dro_grasp.training.data.engine.worker import EngineConfig, Wanted, valid_grasps_of_all
from lab.benchmarks.report import emit, options_of

HANDS = ("assets/barrett_multidex", "assets/allegro_left", "assets/shadowhand")
"""The paper hands."""
SAMPLE = 8
"""Training objects that are drawn, unless all 48 are taken."""
CANDIDATES = 128
"""Grasps synthesized for each pair."""
PUBLISHED = (
    ("DexGraspNet", "under 3", "one A100"), ("BODex", "30 to 50", "one A100"), ("Lightning Grasp", "300 to 1000", "one A100"),
)
"""Valid grasps a second as their authors report them, each by its own measure of validity, and where."""


def training_objects() -> list[str]:
    """Names of the paper's training objects."""
    manifest = Path(os.environ["DRO_GRASP_ASSETS"]) / "objects" / "manifest.json"
    entries = json.loads(manifest.read_text())
    return sorted(e["name"] for e in entries if e["multidex_split"] == "train")


def measure(
    hand_name: str, objects: list[str], seed: int, protocol: str, device: str
) -> tuple[list[tuple[str, int, float]], float]:
    """Per object: its name, valid grasps, CPU time [s]; and the CPU time of loading hand and objects [s]."""
    begin = time.process_time()
    config, rows = EngineConfig(protocol, candidates=CANDIDATES, synthesis=SynthesisConfig(device=device)), []
    hand, preparation = load_hand(hand_name), time.process_time() - begin
    for name in objects:
        begin = time.process_time()
        obj = load_object(name)
        _ = obj.distance_field, obj.parts
        start = time.process_time()
        preparation += start - begin
        (grasps, _), = valid_grasps_of_all(hand, [Wanted(obj, seed, config.candidates)], config)
        rows.append((name, len(grasps), time.process_time() - start))
        print(f"{hand_name} on {name}: {len(grasps)} grasps in {rows[-1][2]:.1f} CPU seconds", file=sys.stderr)
    return rows, preparation


def main() -> None:
    """Measure and print."""
    parser = options_of(__doc__)
    parser.add_argument("--full", action="store_true", help="all 48 training objects")
    parser.add_argument("--seed", type=int, default=0, help="draws the objects and the grasps")
    parser.add_argument("--protocol", default=DEFAULT_PROTOCOL, choices=list(PROTOCOLS), help="that grasps must pass")
    parser.add_argument("--device", default="cpu", help="where energies are computed")
    options = parser.parse_args()
    if "DRO_GRASP_ASSETS" not in os.environ:
        parser.error("set DRO_GRASP_ASSETS to the folder of the development assets")
    torch.set_num_threads(1)
    names = training_objects()
    objects = names if options.full else random.Random(options.seed).sample(names, SAMPLE)
    per_hand, table = {}, []
    for hand in HANDS:
        rows, preparation = measure(hand, objects, options.seed, options.protocol, options.device)
        valid, seconds = sum(r[1] for r in rows), sum(r[2] for r in rows)
        per_hand[hand] = valid / seconds * 3600
        worst = min(rows, key=lambda r: r[1] / r[2])
        table.append([hand, valid, seconds, preparation, per_hand[hand], valid / seconds, worst[0], worst[1] / worst[2] * 3600])
    average = sum(per_hand.values()) / len(per_hand)
    table.append(["average, one core", "", "", "", average, average / 3600, "", ""])
    table += [[f"{name}, published, {where}", "", "", "", "", speed, "", ""] for name, speed, where in PUBLISHED]
    emit(
        f"Synthesis: {CANDIDATES} candidates for each of {len(objects)} of the paper's {len(names)} training objects "
        f"(seed {options.seed}), protocol {options.protocol}; grasps closer than {DUPLICATE_DISTANCE * 1e3:.0f} mm count once",
        table, ["hand", "valid", "CPU time [s]", "preparation [s]", "valid per CPU-hour", "a second", "worst object", "there"],
        {"protocol": options.protocol, "valid_per_cpu_hour": average, "per_hand": per_hand}, options.json,
    )


if __name__ == "__main__":
    main()
