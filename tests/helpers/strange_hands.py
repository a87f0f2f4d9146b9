"""Hands whose limits and names mislead; which way they close is known by hand. Fingers point along z."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tests.helpers.claw_urdf import joint, link
from tests.helpers.folding_hands import limit

QUARTER = math.pi / 2
Hinge = tuple[str, str, float, float, float]  # name, axis, limits [rad], length of the link that it turns [m]


def block(name: str, size: str, at: str = "0 0 0") -> str:
    """A link of one box."""
    shape = f'<origin xyz="{at}"/><geometry><box size="{size}"/></geometry>'
    return f'<link name="{name}"><visual>{shape}</visual><collision>{shape}</collision></link>'


def fixed(child: str, at: str, parent: str = "palm") -> str:
    """A joint that does not move."""
    return joint(f"{child}_mount", parent, child, at, kind="fixed", more="")


def finger(name: str, place: str, hinges: Sequence[Hinge], palm: str = "palm", mimic: str = "") -> str:
    """Links in a row, called after the finger and numbered; `mimic` is for the first joint, `place` is a joint's origin."""
    text, parent, at = "", palm, place
    for number, (called, axis, lower, upper, length) in enumerate(hinges, 1):
        child = f"{name}{number}"
        text += block(child, f"0.012 0.012 {length}", f"0 0 {length / 2}")
        text += joint(called, parent, child, at, axis, limit(lower, upper) + (mimic if number == 1 else ""))
        parent, at = child, f"0 0 {length}"
    return text


def robot(*parts: str) -> str:
    """A URDF."""
    return f'<robot name="strange">{"".join(parts)}</robot>'


def tripod(
    base: tuple[float, float] = (-QUARTER, QUARTER), bend: float = QUARTER, turned: tuple[int, int, int] = (1, 1, 1),
    coupled: bool = False, lengths: tuple[float, float] = (0.06, 0.05), apart: float = 0.035,
) -> str:
    """Finger t at +x and a, b at -x, which turn about their bases, too; all hinges bend as far back as forth.

    The fingers close towards each other; `turned` says for t, a and b whether joints do so by increasing.
    """
    def bends(name: str, way: int) -> list[Hinge]:
        return [(f"{name}_{i}", f"0 {way} 0", -bend, bend, length) for i, length in enumerate(lengths)]

    t = finger("t", f'0.035 0 0.02" rpy="0 0 {math.pi}', bends("t", turned[0]))
    a, b = (finger(name, f"-0.035 {side * apart} 0.02", [(f"{name}_base", f"0 0 {side}", *base, 0.02), *bends(name, way)],
                   mimic='<mimic joint="a_base"/>' if coupled and name == "b" else "")
            for name, side, way in (("a", 1, turned[1]), ("b", -1, turned[2])))
    return robot(block("palm", "0.1 0.11 0.04"), t, a, b)


def human(
    thumb: Sequence[Hinge] = (), names: Sequence[str] = ("index", "middle", "ring", "little"), called: str = "thumb",
    side: int = 1, back: float = 0.0, spread: tuple[float, float] | None = None, tilt: float = 0.0, after: bool = False,
    prefix: str = "", palm: str = "0 0 0",
) -> str:
    """Fingers beside each other that close towards x, and a thumb at +y (a right hand) or -y.

    Joints that spread the fingers have axes out of the palm, tilted by this angle [rad], and lie before or after the knuckle.
    """
    parts = [block(f"{prefix}palm", "0.025 0.09 0.1", palm)]
    for number, name in enumerate(names):
        hinges: list[Hinge] = [(f"{name}_mcp", "0 1 0", -back, 1.57, 0.045), (f"{name}_pip", "0 1 0", -back, 1.57, 0.036)]
        if spread:
            axis = f"{math.cos(tilt):.6f} 0 {math.sin(tilt):.6f}"
            hinges.insert(int(after), (f"{name}_AA", axis, *spread, 0.012))
        parts.append(finger(prefix + name, f"0 {side * (0.033 - 0.066 * number / (len(names) - 1)):.6f} 0.05", hinges,
                            f"{prefix}palm"))
    usual: list[Hinge] = [("thumb_yaw", f"0 0 {side}", -1.3, 0.2, 0.02), *thumb_hinges(0.1, 1.2)]
    parts.append(finger(prefix + called, f'0.01 {side * 0.05} -0.02" rpy="{-side * 0.9} 0 0', thumb or usual, f"{prefix}palm"))
    return robot(*parts)


def thumb_hinges(back: float, forth: float) -> list[Hinge]:
    """Two joints that close a thumb to the palm, and open it so far."""
    return [("thumb_mcp", "0 1 0", -back, forth, 0.04), ("thumb_ip", "0 1 0", -back, forth, 0.03)]


def ring(count: int, spread: float = 0.0, prefix: str = "f") -> str:
    """Equal fingers all around the palm."""
    parts = [block("palm", "0.1 0.1 0.03")]
    for i in range(count):
        angle = 2 * math.pi * i / count
        hinges: list[Hinge] = [(f"swing{i}", "1 0 0", -spread, spread, 0.015)] if spread else []
        hinges += [(f"bend{i}", "0 -1 0", 0, 1.57, 0.05), (f"curl{i}", "0 -1 0", 0, 1.57, 0.04)]
        place = f'{0.04 * math.cos(angle):.6f} {0.04 * math.sin(angle):.6f} 0.015" rpy="0 0 {angle:.6f}'
        parts.append(finger(f"{prefix}{i}_", place, hinges))
    return robot(*parts)


def jaws(*more: str) -> str:
    """Two facing fingers of one joint each, along y, and what else there is."""
    one, other = (finger(name, f"0 {side * 0.04} 0.03", [(f"{name}_joint", f"{side} 0 0", -0.5, 1.0, 0.06)])
                  for name, side in (("one", 1), ("other", -1)))
    return robot(block("palm", "0.04 0.12 0.06"), one, other, *more)


def sliding(name: str, axis: str, lower: float, upper: float, more: str = "", at: str = "0 0 0.03") -> str:
    """A jaw that slides."""
    return link(name) + joint(f"{name}_slide", "palm", name, at, axis, limit(lower, upper) + more, kind="prismatic")
