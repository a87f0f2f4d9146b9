"""The choice of a protocol, for every command that runs trials."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from dro_grasp.simulation.protocols import PROTOCOLS

if TYPE_CHECKING:
    ProtocolName = str
else:
    ProtocolName = Literal[tuple(PROTOCOLS)]
