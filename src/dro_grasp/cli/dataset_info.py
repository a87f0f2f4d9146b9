"""`dro-grasp dataset info`: contents of a data set."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from dro_grasp.cli.output import Flag, print_json, print_table


@dataclass(frozen=True)
class Info:
    """Count the grasps of a data set by hand and object."""

    folder: tyro.conf.Positional[Path]
    """An output folder of `dro-grasp synthesize`, a folder of grasp files, or a grasp file."""
    json: Flag = False
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
