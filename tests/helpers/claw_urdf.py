"""URDF texts of a claw: two facing fingers on a palm; its links and joints may be replaced."""

from __future__ import annotations

from pathlib import Path

PALM = '<link name="palm"><visual><geometry><box size="0.08 0.08 0.02"/></geometry></visual>' \
       '<collision><geometry><box size="0.08 0.08 0.02"/></geometry></collision></link>'
LIMIT = '<limit lower="0" upper="1.5" effort="1" velocity="1"/>'


def link(name: str, geometry: str = '<box size="0.012 0.012 0.06"/>', kinds: tuple[str, ...] = ("visual", "collision")) -> str:
    """A link whose shape begins at its joint."""
    shape = f'<origin xyz="0 0 0.03"/><geometry>{geometry}</geometry>'
    return f'<link name="{name}">' + "".join(f"<{kind}>{shape}</{kind}>" for kind in kinds) + "</link>"


def joint(
    name: str, parent: str, child: str, at: str, axis: str = "0 1 0", more: str = LIMIT, kind: str = "revolute"
) -> str:
    """A joint of a URDF."""
    return (f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/>'
            f'<axis xyz="{axis}"/>{more}</joint>')


def claw(inside: str = "", *, links: str = "", joints: str = "") -> str:
    """Two facing fingers on a palm; parts may be replaced."""
    links = links or link("left") + link("right")
    joints = joints or joint("a", "palm", "left", "-0.035 0 0.01") + joint("b", "palm", "right", "0.035 0 0.01", "0 -1 0")
    return f'<robot name="claw">{PALM}{links}{joints}{inside}</robot>'


def written(folder: Path, text: str, name: str = "claw.urdf") -> Path:
    """The text as a file."""
    path = folder / name
    path.write_text(text)
    return path


def meshed(name: str) -> str:
    """A claw whose left finger is a mesh."""
    return claw(links=link("left", f'<mesh filename="{name}"/>') + link("right"))
