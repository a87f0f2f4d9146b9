"""DexGraspBench's own evaluation, of its grasps and of ours, at several frictions, beside our trial of the same grasps.

    python -m lab.benchmarks.dexgraspbench_official CLONE --python PYTHON --work FOLDER [--own HAND] [--every K] [--json]
                                                [--friction MU ...]

CLONE is a clone of DexGraspBench with its example grasps and its submodule, PYTHON an interpreter with its requirements, and
FOLDER that of `dexgraspbench.py --own HAND --hand CLONE/assets/hand/shadow/right_hand.xml`, which has made and evaluated the
grasps. Ours, and every K-th of the official ones of each pair of object and scale, go to the benchmark's `src/main.py`, as
files in CLONE/output. What it has evaluated before is not evaluated again. HAND has the fingers of the benchmark's Shadow hand
in its order.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dro_grasp.geometry.se3 import roma
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object, processed_objects
from dro_grasp.simulation.protocols import changed
from dro_grasp.simulation.trial import simulate
from dro_grasp.training.data.collections.importing import read_npy
from lab.benchmarks.dexgraspbench import OFFICIAL, OURS, PALM
from lab.benchmarks.report import emit, options_of, rate

TORSION = 0.02
"""Torsional friction of the official evaluation [m]; only the other coefficient is changed."""


def main() -> None:
    """Write, evaluate twice, compare."""
    parser = options_of(__doc__)
    parser.add_argument("clone", type=Path, help="clone of DexGraspBench")
    parser.add_argument("--python", default="python", help="interpreter with the benchmark's requirements")
    parser.add_argument("--work", type=Path, required=True, help="folder of dexgraspbench.py")
    parser.add_argument("--own", default="shadowhand", help="hand of our grasps")
    parser.add_argument("--friction", type=float, nargs="+", default=[0.6, 0.4], help="coefficients; the benchmark's is 0.6")
    parser.add_argument("--every", type=int, default=1, help="take every K-th official grasp of each object and scale")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows, found = [], {}
    for source, hand_name in ((OFFICIAL, str(options.clone / "assets/hand/shadow/right_hand.xml")), (OURS, options.own)):
        hand = load_hand(hand_name)
        files, step = stored(options.work, source, hand), every(source, options)
        pairs = {name: GraspBatch.load(path)[::step] for name, path in files.items()}
        for friction in options.friction:
            held = here(options.clone, hand, pairs, friction)
            theirs = there(options, source, hand, pairs, friction)
            same = [a == b for a, b in zip(held, theirs, strict=True)]
            rows.append([source, friction, len(held), rate(theirs), rate(held), rate(same)])
            found[f"{source}, {friction:g}"] = {"n": len(held), "official": sum(theirs), "here": sum(held), "same": sum(same)}
    emit(f"every {options.every}. official grasp of each object and scale, and ours", rows,
         ["grasps", "friction", "n", "official [%]", "here [%]", "same verdict [%]"], found, options.json)


def every(source: str, options: argparse.Namespace) -> int:
    """Step between the grasps of a source that are taken."""
    return options.every if source == OFFICIAL else 1


def stored(work: Path, source: str, hand: Hand) -> dict[str, Path]:
    """Files of a source by object and scale, as `dexgraspbench.py` names them."""
    head = f"{source} {hand.name} ".replace(" ", "_")
    return {path.stem.removeprefix(head): path for path in sorted(work.glob(f"{head}*.parquet"))}


def here(clone: Path, hand: Hand, pairs: dict[str, GraspBatch], friction: float) -> list[bool]:
    """Verdicts of our trial."""
    folders = {folder.name: folder for folder in processed_objects(clone)}
    held: list[bool] = []
    for pair, grasps in pairs.items():
        name, _, scale = pair.rpartition("@")
        obj = load_object(folders[name], scale=float(scale))
        held += simulate(hand, obj, grasps, changed("dexgraspbench", friction=friction), workers=1).success.tolist()
    return held


def there(options: argparse.Namespace, source: str, hand: Hand, pairs: dict[str, GraspBatch], friction: float) -> list[bool]:
    """Verdicts of the official evaluation, which runs in the clone; a grasp that it cannot evaluate fails."""
    name = f"{source.replace(' ', '-')}-{friction:g}"
    folder, files = options.clone / "output" / f"{name}_shadow" / "graspdata", []
    folders = {path.name: path for path in processed_objects(options.clone)}
    for pair, grasps in pairs.items():
        obj, _, scale = pair.rpartition("@")
        (folder / pair).mkdir(parents=True, exist_ok=True)
        made = entries(hand, grasps, str(folders[obj].relative_to(options.clone)), float(scale))
        for i, (entry, original) in enumerate(zip(made, grasps.provenance, strict=True)):
            files.append(folder / pair / f"{i * every(source, options)}.npy")
            if source == OFFICIAL:  # as it is: its wrist moves between the postures, which our grasps do not have
                shutil.copyfile(options.clone / original, files[-1])
            else:
                np.save(files[-1], np.array(entry, dtype=object), allow_pickle=True)
    subprocess.run([options.python, "src/main.py", "task=eval", f"exp_name={name}", "hand=shadow", "n_worker=1",
                    f"task.miu_coef=[{friction},{TORSION}]", "task.pene_contact_metrics=null", "task.analytic_fc_metrics=null"],
                   cwd=options.clone, check=True, env=os.environ | {"OMP_NUM_THREADS": "1"}, stdout=subprocess.DEVNULL)
    done = [Path(str(file).replace("graspdata", "evaluation")) for file in files]
    return [file.is_file() and bool(read_npy(file).item()["succ_flag"]) for file in done]


def entries(hand: Hand, grasps: GraspBatch, object_path: str, scale: float) -> list[dict[str, Any]]:
    """Grasps as the benchmark reads them: wrist pose about its palm's frame, then all joints, followers included."""
    T = grasps.T_object_wrist.double()
    position = T[:, :3, 3] - PALM * T[:, :3, 2]
    wrist = torch.cat([position, roma.quat_xyzw_to_wxyz(roma.rotmat_to_unitquat(T[:, :3, :3]))], -1)
    assert grasps.pregrasp_joints is not None
    assert grasps.squeeze_joints is not None
    postures = {
        f"{name}_qpos": torch.cat([wrist, (q @ hand.tree.coupling.mT + hand.tree.offset).double()], -1).numpy()
        for name, q in (("pregrasp", grasps.pregrasp_joints), ("grasp", grasps.joints), ("squeeze", grasps.squeeze_joints))}
    pose = np.array([0.0, 0, 0, 1, 0, 0, 0])
    return [{"obj_pose": pose, "obj_scale": scale, "obj_path": object_path, **{k: v[i] for k, v in postures.items()}}
            for i in range(len(grasps))]


if __name__ == "__main__":
    main()
