"""What commands are given: switches and options, protocols by name, grasp files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from dro_grasp.simulation.protocols import PROTOCOLS

if TYPE_CHECKING:
    from dro_grasp.grasps.batch import GraspBatch

    ProtocolName = str
else:
    ProtocolName = Literal[tuple(PROTOCOLS)]

Flag = tyro.conf.FlagCreatePairsOff[bool]
"""A switch that is off by default and has no --no- form."""


def optional(metavar: str, default: str) -> Any:
    """Help settings of an option without a default value: its metavar, and a description of the default."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})")


def load_grasps(path: Path) -> GraspBatch:
    """Read a grasp file that holds at least one grasp.

    Raises:
        GraspFileError: The file is missing, foreign or empty.
    """
    from dro_grasp.errors import GraspFileError
    from dro_grasp.grasps.batch import GraspBatch

    grasps = GraspBatch.load(path)
    if len(grasps) == 0:
        raise GraspFileError(f"{path} holds no grasp; generate again, perhaps without --only-successful")
    return grasps
