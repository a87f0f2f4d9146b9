"""What commands are given: switches and options, protocols by name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import tyro

from dro_grasp.simulation.protocols import PROTOCOLS

if TYPE_CHECKING:
    ProtocolName = str
else:
    ProtocolName = Literal[tuple(PROTOCOLS)]

Ball = tuple[float, float, float, float]
"""Centre and radius [m]."""
Flag = tyro.conf.FlagCreatePairsOff[bool]
"""A switch that is off by default and has no --no- form."""


def optional(metavar: str, default: str) -> Any:
    """Help settings of an option without a default value: its metavar, and a description of the default."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})")
