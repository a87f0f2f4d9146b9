"""`dro-grasp dataset merge`: several data sets as one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from dro_grasp.cli.output import Flag, optional, print_json, print_table


@dataclass(frozen=True)
class Merge:
    """Merge data sets into one file per hand, without near-duplicates and failed grasps.

    Example: dro-grasp dataset merge data more --output grasps --per-pair 150
    """

    inputs: tyro.conf.Positional[tuple[Path, ...]]
    """Output folders of `dro-grasp synthesize`, folders of grasp files, or grasp files."""
    output: Path
    """Folder for the files, one per hand; created if missing, inside an existing folder."""
    per_pair: Annotated[int | None, optional("N", "all")] = None
    """Limit of grasps of a hand on an object; those that cover palm directions best are kept."""
    json: Flag = False
    """Print one JSON object instead of a table."""

    def run(self) -> int:
        """Merge, and write one file per hand."""
        from dro_grasp.datasets.collections.merging import file_name, merge
        from dro_grasp.files import make_folder

        folder = make_folder(self.output)
        rows = []
        for merged in merge(self.inputs, self.per_pair):
            path = folder / file_name(merged.hand)
            merged.save(path)
            rows.append([merged.hand, len(merged.grasps), merged.duplicates, merged.surplus, path.stat().st_size])
        columns = ["hand", "grasps", "duplicates", "surplus", "bytes"]
        if self.json:
            print_json({"output": str(folder), "files": [dict(zip(columns, row, strict=True)) for row in rows]})
        else:
            print_table(f"merged into {folder}", columns, rows, note=f"{sum(row[1] for row in rows)} grasps in all")
        return 0
