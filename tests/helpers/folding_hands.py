"""Hands whose limits let the fingers fold back behind the palm; where they are open is known by hand."""

from __future__ import annotations

import re

from tests.helpers.bracket_hand import bracket_urdf
from tests.helpers.claw_urdf import claw, joint, link


def limit(lower: float, upper: float) -> str:
    """A joint's limits."""
    return f'<limit lower="{lower}" upper="{upper}" effort="1" velocity="1"/>'


def folding_claw(back: float, offset: float = 0.0) -> str:
    """Two facing fingers that stand upright at zero, close by 1.5 rad and open by this angle [rad]; pi/2 lays them flat."""
    ends = limit(-back + offset, 1.5 + offset)
    joints = joint("a", "palm", "left", "-0.035 0 0.01", more=ends) + joint("b", "palm", "right", "0.035 0 0.01", "0 -1 0", ends)
    return claw(links=link("left") + link("right"), joints=joints)


def folding_bracket(back: float, side: float = 1.0, pattern: str = "base|knuckle") -> str:
    """`bracket_urdf` with the joints of this pattern opening by this angle beyond the straight finger at zero [rad]."""
    def widened(match: re.Match[str]) -> str:
        return match[0].replace('lower="0"', f'lower="{-back}"')

    return re.sub(rf'<joint name="({pattern})\d".*?</joint>', widened, bracket_urdf(side))
