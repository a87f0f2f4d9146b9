"""Notes that are taken while a hand description is loaded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Note:
    """One thing that loading derived, repaired or found wrong."""

    level: Literal["info", "warning", "error"]
    subject: str
    """The link, joint or file concerned."""
    text: str
