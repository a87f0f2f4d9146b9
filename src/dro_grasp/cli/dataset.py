"""`dro-grasp dataset`: commands for data sets of grasps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from dro_grasp.cli.dataset_bundle import BundleCommand
from dro_grasp.cli.dataset_check import Check
from dro_grasp.cli.dataset_filter import Filter
from dro_grasp.cli.dataset_import import Import
from dro_grasp.cli.dataset_info import Info
from dro_grasp.cli.dataset_merge import Merge
from dro_grasp.cli.dataset_report import Report


@dataclass(frozen=True)
class Dataset:
    """Inspect, merge, check, filter, import and bundle grasp data sets."""

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
