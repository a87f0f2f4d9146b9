"""Hands whose limits let the fingers fold back behind the palm; where they are open is known by hand."""

from __future__ import annotations

import re

from tests.helpers.bracket_hand import bracket_urdf
from tests.helpers.claw_urdf import claw, joint


def limit(lower: float, upper: float) -> str:
    """A joint's limits."""
    return f'<limit lower="{lower}" upper="{upper}" effort="1" velocity="1"/>'


def folding_claw(back: float) -> str:
    """Two facing fingers that stand upright at zero, close by 1.5 rad and open by this angle [rad]; pi/2 lays them flat."""
    ends = limit(-back, 1.5)
    left = joint("a", "palm", "left", "-0.035 0 0.01", more=ends)
    return claw(joints=left + joint("b", "palm", "right", "0.035 0 0.01", "0 -1 0", ends))


def folding_bracket(back: float, side: float = 1.0, pattern: str = "base|knuckle") -> str:
    """`bracket_urdf` with the joints of this pattern opening by this angle beyond the straight finger at zero [rad]."""
    def widened(match: re.Match[str]) -> str:
        return match[0].replace('lower="0"', f'lower="{-back}"')

    return re.sub(rf'<joint name="({pattern})\d".*?</joint>', widened, bracket_urdf(side))
