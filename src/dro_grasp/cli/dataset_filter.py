"""`dro-grasp dataset filter`: the grasps of a data set that pass a trial."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from dro_grasp.cli.output import Flag, optional, print_json, print_table, progress_bar
from dro_grasp.cli.protocol_name import ProtocolName


@dataclass(frozen=True)
class Filter:
    """Evaluate all grasps of a data set, and keep those that pass.

    Example: dro-grasp dataset filter theirs.parquet --protocol strict --output kept
    """

    inputs: tyro.conf.Positional[tuple[Path, ...]]
    """Output folders of `dro-grasp synthesize`, folders of grasp files, or grasp files."""
    output: Path
    """Folder for the files, one per hand; created if missing, inside an existing folder."""
    protocol: ProtocolName = "strict"
    """Protocol of the trial."""
    friction: Annotated[float | None, optional("MU", "the protocol's")] = None
    """Friction coefficient between hand and object."""
    json: Flag = False
    """Print one JSON object instead of a table."""

    def run(self) -> int:
        """Evaluate, and write one file per hand."""
        from dro_grasp.datasets.collections.checking import keep_passing
        from dro_grasp.datasets.collections.collection import read_collection
        from dro_grasp.datasets.collections.merging import file_name
        from dro_grasp.files import make_folder
        from dro_grasp.grasps.batch import GraspBatch
        from dro_grasp.simulation.protocols import changed

        rules = changed(self.protocol, friction=self.friction)
        folder = make_folder(self.output)
        pairs = [pair for path in self.inputs for pair in read_collection(path, only_successful=False)]
        with progress_bar("evaluating", self.json) as progress:
            kept = keep_passing(pairs, rules, progress)
        by_hand: dict[str, list[GraspBatch]] = {}
        for _, passed in kept:
            by_hand.setdefault(passed.hand, []).append(passed)
        for hand, batches in by_hand.items():
            GraspBatch.concatenate(batches).save(folder / file_name(hand))
        rows = [[pair.hand, pair.object, len(pair.grasps), len(passed)] for pair, passed in kept]
        total, passed = sum(row[2] for row in rows), sum(row[3] for row in rows)
        if self.json:
            columns = ("hand", "object", "grasps", "kept")
            print_json({"output": str(folder), "protocol": rules.label, "grasps": total, "kept": passed,
                        "pairs": [dict(zip(columns, row, strict=True)) for row in rows]})
        else:
            print_table(f"protocol {rules.label}", ["hand", "object", "grasps", "kept"], rows,
                        note=f"{passed} of {total} kept, in {folder}")
        return 0
