"""`dro-grasp dataset report`: statistics of a data set."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from dro_grasp.cli.output import Flag, optional, print_json, print_table, progress_bar, say_aside


@dataclass(frozen=True)
class Report:
    """Report yields, failures and diversity of a data set: palm directions, wrist rolls, grasp sizes, joints.

    Example: dro-grasp dataset report data --output report.html
    """

    inputs: tyro.conf.Positional[tuple[Path, ...]]
    """Output folders of `dro-grasp synthesize`, folders of grasp files, or grasp files."""
    output: Annotated[Path | None, optional("PATH", "no page")] = None
    """Self-contained HTML page with charts and pictures."""
    json: Flag = False
    """Print one JSON object instead of a table."""

    def run(self) -> int:
        """Measure, print, write the page."""
        from dro_grasp.datasets.collections.collection import read_collection
        from dro_grasp.evaluation.coverage import measure_coverage
        from dro_grasp.files import check_output
        from dro_grasp.viewer.dataset_pages import write_report

        if self.output is not None:
            check_output(self.output)
        hands = measure_coverage(pair for path in self.inputs for pair in read_collection(path))
        if self.output is not None:
            with progress_bar("drawing", self.json) as progress:
                write_report(hands, self.output, progress)
        if self.json:
            print_json({"hands": [h.to_dict() for h in hands], "output": None if self.output is None else str(self.output)})
            return 0
        rows = [[h.grasps.hand, len(h.grasps), len(h.pairs), h.yields.per_cpu_hour, *h.diversity.values()] for h in hands]
        print_table("data set", ["hand", "grasps", "objects", "per CPU-hour", "diversity", "of wrist", "of joints"], rows,
                    note="" if self.output is None else f"page: {self.output}")
        for h in hands:
            for pair in h.pairs:
                if not pair.grasps:
                    say_aside(f"{h.grasps.hand} on {pair.object}: no grasp, {pair.reason}")
        return 0
