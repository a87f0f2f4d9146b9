"""A hand with three of its four fingers on a bracket that is fixed to the palm: an anatomy that is easy to miscount."""

from __future__ import annotations

from pathlib import Path

import dro_grasp as dro
from dro_grasp.hands.hand import Hand
from tests.helpers.claw_urdf import PALM, joint, link, written


def bracket_urdf(side: float = 1.0) -> str:
    """Fingers up along z, palm towards x, an opposing thumb at +y (a right hand) or -y; a pad fixed beside the first finger."""
    palm = PALM.replace("0.08 0.08 0.02", "0.02 0.09 0.1")
    bracket = link("bracket", '<box size="0.012 0.09 0.02"/>')
    links = bracket + "".join(link(f"{name}{i}") for i in range(3) for name in ("proximal", "distal"))
    joints = joint("mount", "palm", "bracket", "0 0 0.01", kind="fixed", more="")
    for i in range(3):
        joints += joint(f"base{i}", "bracket", f"proximal{i}", f"0 {0.03 * (i - 1)} 0.04")
        joints += joint(f"knuckle{i}", f"proximal{i}", f"distal{i}", "0 0 0.06")
    links += link("pad", '<box size="0.004 0.012 0.02"/>') + link("thumb")
    joints += joint("glue", "proximal0", "pad", "-0.01 0 0.02", kind="fixed", more="")
    joints += joint("oppose", "palm", "thumb", f"0.09 {side * 0.05} 0.03", "0 -1 0")
    return f'<robot name="bracket_hand">{palm}{links}{joints}</robot>'


def bracket_hand(folder: Path, side: float = 1.0) -> Hand:
    """The hand, loaded from a file in this folder."""
    return dro.load_hand(written(folder, bracket_urdf(side), "bracket_hand.urdf"))
