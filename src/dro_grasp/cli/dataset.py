"""`dro-grasp dataset`: work with data sets of grasps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from dro_grasp.cli.dataset_bundle import BundleCommand
from dro_grasp.cli.dataset_import import Import
from dro_grasp.cli.dataset_report import Report
from dro_grasp.cli.dataset_trials import Check, Filter
from dro_grasp.cli.output import optional, print_json, print_table


@dataclass(frozen=True)
class Info:
    """Count the grasps of a data set, per hand and object."""

    folder: tyro.conf.Positional[Path]
    """A folder that `dro-grasp synthesize` filled, a folder of grasp files, or one grasp file."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print one JSON object instead of a table."""

    def run(self) -> int:
        """Count."""
        from dro_grasp.datasets.collections.collection import count_collection

        counts = count_collection(self.folder)
        total = sum(sum(c.values()) for c in counts.values())
        if self.json:
            print_json({"total": total, "hands": counts})
        else:
            rows = [[hand, len(c), sum(c.values()), min(c.values())] for hand, c in counts.items()]
            print_table(f"data set {self.folder}", ["hand", "objects", "grasps", "fewest"], rows, note=f"{total} grasps in all")
        return 0


@dataclass(frozen=True)
class Merge:
    """Join data sets into one compact file a hand: near-duplicates once, failures left out.

    Example: dro-grasp dataset merge data more --output grasps --per-pair 150
    """

    inputs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders that `dro-grasp synthesize` filled, folders of grasp files, or grasp files."""
    output: Path
    """Folder for the files, one a hand; made when only itself is missing."""
    per_pair: Annotated[int | None, optional("N", "all")] = None
    """Most grasps of a hand on an object; of more, those that spread best over palm directions are kept."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print one JSON object instead of a table."""

    def run(self) -> int:
        """Merge, then write all files."""
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


@dataclass(frozen=True)
class Dataset:
    """Work with grasp data sets."""

    command: (
        Annotated[Info, tyro.conf.subcommand("info")]
        | Annotated[Import, tyro.conf.subcommand("import")]
        | Annotated[Report, tyro.conf.subcommand("report")]
        | Annotated[Merge, tyro.conf.subcommand("merge")]
        | Annotated[Check, tyro.conf.subcommand("check")]
        | Annotated[Filter, tyro.conf.subcommand("filter")]
        | Annotated[BundleCommand, tyro.conf.subcommand("bundle")]
    )

    def run(self) -> int:
        """Run the subcommand."""
        return self.command.run()
