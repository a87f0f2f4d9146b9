"""What loading a hand description finds on the way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Note:
    """Something that loading found: what was derived, repaired or is wrong."""

    level: Literal["info", "warning", "error"]
    subject: str
    """The link, joint or file concerned."""
    text: str
