"""Contacts and constraints of worlds in which hands close on objects: what `dro_grasp.simulation.warp_worlds` makes room for.

Each hand's stored grasps close as hard as under `strict`, on MuJoCo; each world counts with the most that it ever has.

    python -m lab.studies.contact_room [FILE ...] [--grasps 60] [--protocol strict] [--json]

Stored grasps are of development assets.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.simulation.rollout import rollouts
from dro_grasp.simulation.scene import scene_of
from lab.benchmarks.report import emit

FOLDER = Path("data/grasps")
COUNTS = ("ncon", "nefc")  # Contacts and constraints. Source: MjData
EVERY = 0.01  # Time between two looks [s]


def most(grasps: GraspBatch, protocol: str) -> Int[np.ndarray, "n 2"]:
    """The most of COUNTS in each grasp's world while the hand closes."""
    hand, found = load_hand(grasps.hand), []
    for name, own in grasps.by_object():
        scene = scene_of(hand, load_object(name), own, protocol)
        for _, rollout in rollouts(scene, hand, own, None):
            seen = []
            for _ in range(round(scene.protocol.closing_time / EVERY)):
                rollout.press(rollout.targets[-1], EVERY)
                seen.append(np.stack([rollout.batch.bind(name).reshape(-1) for name in COUNTS], 1))
            found.append(np.max(seen, 0))
    return np.concatenate(found)


def main(argv: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, default=sorted(FOLDER.glob("*.parquet")), help="stored grasps")
    parser.add_argument("--grasps", type=int, default=60, help="of each file, drawn at random")
    parser.add_argument("--protocol", default="strict")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    rows = []
    for path in options.files:
        grasps = GraspBatch.load(path)
        drawn = torch.randperm(len(grasps), generator=torch.Generator().manual_seed(0))[: options.grasps]
        counts = most(grasps[drawn.sort().values], options.protocol)
        contacts, constraints = counts.T
        rows.append([grasps.hand, len(counts), contacts.mean(), *np.quantile(contacts, (0.99, 1.0)),
                     *np.quantile(constraints, (0.5, 0.99, 1.0))])
    emit(f"Contacts and constraints of a world while a hand closes under {options.protocol}", rows,
         ["hand", "worlds", "contacts, mean", "99 %", "most", "constraints, median", "99 %", "most"],
         {"largest mean of contacts": max(row[2] for row in rows), "constraints, 99 %": [row[6] for row in rows]}, options.json)


if __name__ == "__main__":
    main()
