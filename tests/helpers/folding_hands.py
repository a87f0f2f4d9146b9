"""Hands whose limits let the fingers fold back behind the palm; where they are open is known by hand."""

from __future__ import annotations

import math
import re

from tests.helpers.bracket_hand import bracket_urdf
from tests.helpers.claw_urdf import claw, joint, link


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


def swinging_ring(back: float) -> str:
    """Three upright fingers about a palm; each swings around it, and bends at two joints, outwards by this angle [rad].

    The second bend turns the other way than the first; of one finger, the swing reaches farther to the other side.
    """
    links, joints = [], []
    for i, swing in enumerate([limit(-1.3, 0.5), limit(-0.5, 1.3), limit(-1.3, 0.5)]):
        angle = 2 * math.pi * i / 3
        place = f'{0.03 * math.cos(angle):.6f} {0.03 * math.sin(angle):.6f} 0.01" rpy="0 0 {angle:.6f}'
        links += [link(f"base{i}", '<box size="0.02 0.02 0.04"/>'), link(f"middle{i}"), link(f"tip{i}")]
        joints += [joint(f"swing{i}", "palm", f"base{i}", place, "1 0 0", swing),
                   joint(f"knuckle{i}", f"base{i}", f"middle{i}", "0 0 0.03", "0 1 0", limit(-1.57, back)),
                   joint(f"bend{i}", f"middle{i}", f"tip{i}", "0 0 0.06", "0 -1 0", limit(-back, 1.57))]
    return claw(links="".join(links), joints="".join(joints))


def rolling_ring(end: float) -> str:
    """Three upright fingers about a palm, which bend at three joints, each as far as this angle [rad]; pi rolls them up."""
    links, joints = [], []
    for i in range(3):
        angle = 2 * math.pi * i / 3
        place = f'{0.04 * math.cos(angle):.6f} {0.04 * math.sin(angle):.6f} 0.02" rpy="0 0 {angle:.6f}'
        links += [link(f"base{i}", '<box size="0.02 0.02 0.05"/>'), link(f"middle{i}"), link(f"tip{i}")]
        joints += [joint(f"knuckle{i}", "palm", f"base{i}", place, "0 -1 0", limit(-0.3, end)),
                   joint(f"bend{i}", f"base{i}", f"middle{i}", "0 0 0.05", "0 -1 0", limit(0, end)),
                   joint(f"curl{i}", f"middle{i}", f"tip{i}", "0 0 0.06", "0 -1 0", limit(0, end))]
    return claw(links="".join(links), joints="".join(joints))
