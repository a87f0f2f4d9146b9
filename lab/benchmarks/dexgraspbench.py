"""DexGraspBench: its official grasps under our protocol beside its own evaluation, and our grasps on its objects.

    python -m lab.benchmarks.dexgraspbench FOLDER --hand RIGHT_HAND_XML [--own HAND] [--num N] [--work FOLDER] [--json]

FOLDER is a clone of DexGraspBench with its example grasps, best after its own `script/example.sh`, whose results are then set
beside ours, grasp by grasp. RIGHT_HAND_XML is the description of the Shadow hand in it; --own is the hand of our grasps. With
--work, pairs that were measured before are not measured again.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from dro_grasp.compare.metrics import wilson_interval
from dro_grasp.compare.stages import pair_seed
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import SCALES, load_object, processed_objects
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.config import GraspRequest
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.stages import evaluate
from dro_grasp.simulation.contacts import NAMES, with_contacts
from dro_grasp.training.data.collections.importing import ForeignGrasp, in_order, read_foreign, read_npy
from lab.benchmarks.report import emit, options_of, rate

PALM = 0.034
"""Height of the palm in the frame of the official postures, along z [m]. Source: the benchmark's description of the hand."""
THEIRS = {"object_penetration": "ho_pene", "deepest_self_penetration": "self_pene", "touching_links": "contact_num",
          "contact_distance": "contact_dist", "contact_spread": "contact_consis", "q1": "q1_metric",
          "wrench_error": "qp_metric"}
"""Our metrics by the names of the official evaluation; for Q1 it states 2 minus the value."""
OFFICIAL, OURS = "official grasps", "ours"
"""Rows of the table of success."""


def main() -> None:
    """Measure and print."""
    parser = options_of(__doc__)
    parser.add_argument("folder", type=Path, help="clone of DexGraspBench")
    parser.add_argument("--hand", help="hand of the official grasps; without it they are left out")
    parser.add_argument("--own", help="hand of our grasps; without it they are left out")
    parser.add_argument("--num", type=int, default=20, help="our grasps on each object at each scale")
    parser.add_argument("--work", type=Path, help="folder for measured pairs")
    options = parser.parse_args()
    torch.set_num_threads(1)
    measured = {}
    if options.hand:
        measured[OFFICIAL] = GraspBatch.concatenate(list(official(options)))
    if options.own:
        measured[OURS] = GraspBatch.concatenate(list(ours(options)))
    rows, found = [], {}
    for source, grasps in measured.items():
        rows += [[source, name, *success(grasps[rows])] for name, rows in groups(grasps).items()]
        found[source] = {"n": len(grasps), "success": int(grasps.success.sum())}
    columns = ["grasps", "object", "n", "success [%]", *NAMES]
    emit("success under dexgraspbench, and means of the analytic metrics [m]", rows, columns, found, options.json)
    if OFFICIAL in measured and (theirs := official_results(options.folder)):
        compare(measured[OFFICIAL], theirs, options.json)


def official(options: argparse.Namespace) -> Iterator[GraspBatch]:
    """The official grasps after our trial, pair by pair."""
    hand, files = load_hand(options.hand), sorted(options.folder.glob("output/**/graspdata/**/*.npy"))
    folders = {folder.name: folder for folder in processed_objects(options.folder)}
    pairs: dict[tuple[str, float], list[tuple[Path, ForeignGrasp]]] = {}
    for file in files:
        for grasp in read_foreign(file, "dexgraspbench"):
            pairs.setdefault((grasp.object, grasp.scale), []).append((file, grasp))
    for (name, scale), members in pairs.items():
        obj = load_object(folders[name], scale=scale)
        made = as_batch(hand, obj, [grasp for _, grasp in members])
        made = made.replace(provenance=tuple(str(file.relative_to(options.folder)) for file, _ in members))
        yield measured_once(options, OFFICIAL, hand, obj, made)


def ours(options: argparse.Namespace) -> Iterator[GraspBatch]:
    """What `generate` returns, after the trial, pair by pair."""
    hand, predictor = load_hand(options.own), GraspPredictor()
    for folder in processed_objects(options.folder):
        for scale in SCALES:
            obj = load_object(folder, scale=scale)
            begin = time.process_time()
            stored = stored_file(options, OURS, hand, obj)
            made = None
            if stored is None or not stored.is_file():
                made = predictor.run(GraspProblem(hand, obj), GraspRequest(options.num, pair_seed(0, hand, obj))).grasps
                seconds = (time.process_time() - begin) / options.num
                made = made.replace(extra=made.extra | {"cpu_seconds": torch.full((len(made),), seconds)})
            yield measured_once(options, OURS, hand, obj, made)


def stored_file(options: argparse.Namespace, source: str, hand: Hand, obj: ObjectModel) -> Path | None:
    """Where a measured pair is kept."""
    return options.work and options.work / f"{source} {hand.name} {obj.name}.parquet".replace(" ", "_")


def measured_once(
    options: argparse.Namespace, source: str, hand: Hand, obj: ObjectModel, grasps: GraspBatch | None
) -> GraspBatch:
    """The grasps after their trial and with their metrics, from the work folder if they are there."""
    stored = stored_file(options, source, hand, obj)
    if stored is not None and stored.is_file():
        return GraspBatch.load(stored)
    assert grasps is not None
    done = with_contacts(hand, obj, evaluate(GraspProblem(hand, obj), grasps, "dexgraspbench", workers=1))
    if stored is not None:
        stored.parent.mkdir(parents=True, exist_ok=True)
        done.save(stored)
    return done


def as_batch(hand: Hand, obj: ObjectModel, grasps: list[ForeignGrasp]) -> GraspBatch:
    """Official grasps in the frame of our root link, the palm, with their pregrasps and squeezes."""
    T_frame_palm = np.eye(4)
    T_frame_palm[2, 3] = PALM
    T = torch.from_numpy(np.stack([grasp.T_object_wrist @ T_frame_palm for grasp in grasps])).float()
    names = hand.tree.moving_names, hand.tree.joint_names
    q, pregrasp, squeeze = (
        torch.tensor([in_order(joints, *names) for joints in column if joints is not None])
        for column in zip(*((g.joints, g.pregrasp, g.squeeze) for g in grasps), strict=True))
    return GraspBatch.create(hand, obj, T, q, pregrasp_joints=pregrasp, squeeze_joints=squeeze)


def groups(grasps: GraspBatch) -> dict[str, list[int]]:
    """Rows of each object at all scales, of each scale, and of all."""
    found: dict[str, list[int]] = {}
    for i, name in enumerate(grasps.object):
        for key in (name.rpartition("@")[0][:24], f"scale {name.rpartition('@')[2]}", "all"):
            found.setdefault(key, []).append(i)
    return dict(sorted(found.items(), key=lambda item: (item[0] == "all", item[0].startswith("scale"))))


def success(grasps: GraspBatch) -> list[object]:
    """Number, success with its interval, and means of the metrics."""
    means = [float(torch.as_tensor(grasps.extra[name]).mean()) for name in NAMES]
    return [len(grasps), rate(grasps.success), *means]


def official_results(folder: Path) -> dict[str, dict[str, float]]:
    """The official evaluation's results by the file of the grasp; empty where it was not run."""
    files = folder.glob("output/**/evaluation/**/*.npy")
    return {str(file.relative_to(folder)).replace("/evaluation/", "/graspdata/"): read_npy(file).item() for file in files}


def compare(grasps: GraspBatch, theirs: dict[str, dict[str, float]], as_json: bool) -> None:
    """Print the agreement of verdicts and of metrics."""
    both = [i for i, file in enumerate(grasps.provenance) if file in theirs]
    results = [theirs[grasps.provenance[i]] for i in both]
    grasps, held = grasps[both], torch.tensor([bool(result["succ_flag"]) for result in results])
    counts = {f"{a} there, {b} here": int(((held == (a == "holds")) & (grasps.success == (b == "holds"))).sum())
              for a in ("holds", "fails") for b in ("holds", "fails")}
    agreed = int((held == grasps.success).sum())
    low, high = wilson_interval(agreed, len(both))
    rows = []
    for name, their_name in THEIRS.items():
        mine = torch.as_tensor(grasps.extra[name]).double().numpy()
        there = np.array([float(result[their_name]) for result in results])
        there = 2 - there if name == "q1" else there
        gap = np.abs(mine - there)
        rows.append([name, float(mine.mean()), float(there.mean()), float(np.median(gap)), float(np.quantile(gap, 0.9)),
                     float(np.corrcoef(mine, there)[0, 1])])
    print()
    emit(f"metrics of {len(both)} grasps, ours beside the official evaluation's", rows,
         ["metric", "mean here", "mean there", "median difference", "90 % are below", "correlation"],
         {"agreement [%]": 100 * agreed / len(both), "interval [%]": f"{100 * low:.1f}-{100 * high:.1f}", **counts}, as_json)


if __name__ == "__main__":
    main()
