"""Quality of a data set: speed and completeness of its production, diversity, and whether its grasps hold again.

Yields come from the notes in the data set's files, for the pairs of the paper hands. Grasps are then evaluated again in
this new process: unchanged, with lower and higher friction, and with a lighter and a heavier object.

    python -m lab.benchmarks.dataset FOLDER [--sample 500] [--goal 150] [--json]
"""

from __future__ import annotations

from pathlib import Path

import torch

from dro_grasp.compare.metrics import wilson_interval
from dro_grasp.simulation.protocols import changed
from dro_grasp.training.data.collections.checking import check
from dro_grasp.training.data.collections.collection import PairGrasps, read_collection
from dro_grasp.training.data.collections.coverage import measure_coverage
from dro_grasp.training.data.engine.shards import Yield
from lab.benchmarks.report import emit, options_of
from lab.benchmarks.synthesis import HANDS, training_objects

TRIALS = (
    ("strict, as stored", 1.0, 1.0), ("friction x 0.7", 0.7, 1.0), ("friction x 1.5", 1.5, 1.0), ("mass x 0.5", 1.0, 0.5),
    ("mass x 2", 1.0, 2.0),
)
"""Name, factor of the friction, factor of the mass."""


def making(pairs: list[PairGrasps], goal: int) -> list[list[object]]:
    """Per paper hand: grasps, speed on the training objects, complete pairs, diversity on all objects."""
    train, rows = set(training_objects()), []
    for hand in HANDS:
        own = [p for p in pairs if p.hand == hand]
        made = sum((p.made for p in own if p.object in train), Yield())
        found = measure_coverage(own)[0]
        complete = sum(len(p.grasps) >= goal for p in own)
        rows.append([hand, len(found.grasps), made.per_cpu_hour, made.preparation_seconds / max(made.cpu_seconds, 1e-9),
                     f"{complete} of {len(own)}", *found.diversity.values()])
    return rows


def again(pairs: list[PairGrasps], sample: int) -> list[list[object]]:
    """Per variation of the trial: how many of the sample succeed."""
    rows = []
    for name, friction, mass in TRIALS:
        found = check(pairs, sample, changed("strict", friction=friction, mass_factor=mass))
        low, high = wilson_interval(found.succeeded, found.evaluated)
        rows.append([name, found.evaluated, 100 * found.succeeded / found.evaluated, f"{100 * low:.1f}-{100 * high:.1f}"])
    return rows


def main() -> None:
    """Measure and print."""
    parser = options_of(__doc__)
    parser.add_argument("folder", type=Path, help="a data set with the paper hands")
    parser.add_argument("--sample", type=int, default=500, help="grasps to evaluate again, of all hands")
    parser.add_argument("--goal", type=int, default=150, help="grasps of a complete pair")
    options = parser.parse_args()
    torch.set_num_threads(1)
    pairs = list(read_collection(options.folder))
    rows = making(pairs, options.goal)
    speeds = {str(row[0]): row[2] for row in rows}
    repeated = again(pairs, options.sample)
    table = [[row[0], row[1], row[2], row[3], row[4], f"{row[5]:.3f}", f"{row[6]:.3f}", f"{row[7]:.3f}"] for row in rows]
    if not options.json:
        emit("Making", table, ["hand", "grasps", "valid per CPU-hour", "preparation share", f"pairs with {options.goal}",
                               "diversity", "of the wrist", "of the joints"], {}, False)
        print()
    emit(f"{options.sample} random grasps of {len({p.hand for p in pairs})} hands evaluated again", repeated,
         ["trial", "grasps", "success [%]", "95 %"],
         {"valid_per_cpu_hour": speeds, "diversity": {str(r[0]): r[5] for r in rows},
          "pairs": {str(r[0]): r[4] for r in rows},
          "again": [{"trial": r[0], "asked": r[1], "success": r[2]} for r in repeated]}, options.json)


if __name__ == "__main__":
    main()
